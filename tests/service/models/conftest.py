"""A model whose aliases can be set and whose versions can be deleted."""

from typing import Any

import pytest

from tests.service.models.versions import publish


@pytest.fixture
def arm(api: Any, request: pytest.FixtureRequest) -> str:
    """A model of three versions, of which the third serves; each test has its own."""
    name = request.node.originalname.removeprefix("test_").replace("_", "-")[:50].rstrip("-")
    assert [publish(api, name) for _ in range(3)] == [1, 2, 3]
    return name
