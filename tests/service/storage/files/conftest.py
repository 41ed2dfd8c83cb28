"""Shared stores: a folder, and a bucket of a real S3 endpoint."""

import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from service.storage.files import Files
from tests.choosing import slow
from tests.service.data import stream
from tests.system.cluster import conftest as cluster
from tests.system.cluster.servers import BUCKET, S3

s3 = cluster.s3
_prefixes = count(1)


def put(files: Files, dataset: str = "ds_one", **options: Any) -> str:
    """Store a recording as a data set; return its checksum."""
    samples = stream(**{"samples": 10, **options})
    return files.write_samples(dataset, len(samples), samples.n_joints, partial(getattr, samples))


@pytest.fixture
def bucket(s3: S3) -> Iterator[str]:
    """A prefix in a bucket of the tests."""
    with patch.dict(os.environ, s3.env):
        yield f"s3://{BUCKET}/files{next(_prefixes)}"


@pytest.fixture(params=["folder", slow("bucket")])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A shared store of either kind."""
    if request.param == "bucket":
        return str(request.getfixturevalue("bucket"))
    folder = tmp_path / "mounted here"
    folder.mkdir()
    return folder.as_uri()


@pytest.fixture
def host(url: str, tmp_path: Path) -> Callable[..., Files]:
    """Return a function that opens the files of a service with a home of its own, by name."""
    return lambda name="one", **more: Files(tmp_path / name, url, **more)
