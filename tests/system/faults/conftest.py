"""Fixtures of tests/service that these tests use."""

from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    api,
    home,
    server,
    services_share,
    strict,
    strict_service,
)
