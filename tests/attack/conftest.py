"""Fixtures of tests/service, and the seed of all attacks."""

import pytest

from tests.attack.attacked import SEED
from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    services_share,
)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the seed of the attacks."""
    terminalreporter.write_line(f"attacks: LIPSERVE_ATTACK_SEED={SEED}")
