"""The archive of a model."""

from typing import Any

import pytest

from tests.service.models.archives.packing import exported, unpack


@pytest.fixture(scope="module")
def archive(api: Any, trained: Any) -> bytes:
    """The archive of a trained pendulum."""
    return exported(api, trained.name)


@pytest.fixture(scope="module")
def files(archive: bytes) -> dict[str, bytes]:
    """The members of the archive by name."""
    return unpack(archive)
