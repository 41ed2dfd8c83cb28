"""Fixtures of servers that several services share; both start in about two seconds."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cluster.servers import S3, Postgres, Shared, server_folder, sharing

# as in tests/service: processes with low priority would hardly run beside other tests
for name in ("LIPSERVE_TRAINING_NICENESS", "LIPSERVE_LEARNER_NICENESS"):
    os.environ.setdefault(name, "0")


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL server; a test that stops it must restart it."""
    with server_folder() as folder:
        server = Postgres(folder)
        yield server
        server.close()


@pytest.fixture(scope="session")
def s3() -> Iterator[S3]:
    """An S3 endpoint; a test that stops it must restart it."""
    server = S3()
    yield server
    server.close()


@pytest.fixture
def shared(postgres: Postgres, s3: S3, tmp_path: Path) -> Iterator[Shared]:
    """A database and a bucket prefix for one test: `.settings("one")`, `.env()`, `.home("one")`."""
    with sharing(postgres, s3, tmp_path) as made:
        yield made
