"""Fixtures of other rooms."""

from tests.service.cli.conftest import lipserve  # noqa: F401 - a fixture
