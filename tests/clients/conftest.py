"""What tests of the service share."""

from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    api,
    home,
    pendulum,
    server,
    services_share,
    streaming,
    strict,
    strict_service,
    trained,
)
