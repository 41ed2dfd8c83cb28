"""Servers that the tests of several services share: starting both takes about two seconds."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cluster.servers import S3, Postgres, Shared, server_folder, sharing

# as in tests/service: processes that give way hardly get to run beside other parts of the tests
for name in ("LIPSERVE_TRAINING_NICENESS", "LIPSERVE_LEARNER_NICENESS"):
    os.environ.setdefault(name, "0")


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL server; a test that stops it starts it again."""
    with server_folder() as folder:
        server = Postgres(folder)
        yield server
        server.close()


@pytest.fixture(scope="session")
def s3() -> Iterator[S3]:
    """An S3 endpoint; a test that stops it starts it again."""
    server = S3()
    yield server
    server.close()


@pytest.fixture
def shared(postgres: Postgres, s3: S3, tmp_path: Path) -> Iterator[Shared]:
    """A database and a prefix for the services of one test: `.settings("one")`, `.env()`, `.home("one")`."""
    with sharing(postgres, s3, tmp_path) as made:
        yield made
