"""Fixtures from other folders."""

from tests.service.cli.conftest import lipserve  # noqa: F401 - a fixture
