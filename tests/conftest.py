"""Settings of the whole suite."""

from __future__ import annotations

import pytest
from hypothesis import settings

# derandomized: a failure on one machine is a failure on every machine
settings.register_profile("lipserve", derandomize=True, deadline=None, max_examples=20)
settings.register_profile("thorough", settings.get_profile("lipserve"), max_examples=100)  # of `make test-all`
settings.load_profile("lipserve")


def pytest_addoption(parser: pytest.Parser) -> None:
    """What services that the tests start store things in."""
    parser.addoption(
        "--backend",
        choices=("own", "shared"),
        default="own",
        help="own: SQLite and files of each service (the default); shared: PostgreSQL and S3, started by the tests",
    )
