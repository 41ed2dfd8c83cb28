"""What tests of the service share."""

from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    home,
    services_share,
)
