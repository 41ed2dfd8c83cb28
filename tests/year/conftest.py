"""Fixtures of tests/service."""

from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    services_share,
)
