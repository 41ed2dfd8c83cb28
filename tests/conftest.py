"""Settings of the whole suite, and which of its tests run in one process where several share the work."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.choosing import mark_repetitions

# derandomized: a failure on one machine is a failure on every machine
settings.register_profile("lipserve", derandomize=True, deadline=None, max_examples=10)
settings.register_profile("thorough", settings.get_profile("lipserve"), max_examples=100)  # of `make test-all`
settings.load_profile("lipserve")

TOGETHER = (
    "tests/browser/",
    "tests/cluster/",
    "tests/docs/",
    "tests/clients/",
    "tests/service/test_stream_",
    "tests/service/cli/",
)
"""Beginnings of the paths of tests that share what takes seconds to start: each runs in one process. The longest first:
what takes long and begins late keeps the other processes waiting."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """What services that the tests start store things in, and where pictures go."""
    parser.addoption(
        "--backend",
        choices=("own", "shared"),
        default="own",
        help="own: SQLite and files of each service (the default); shared: PostgreSQL and S3, started by the tests",
    )
    parser.addoption("--pictures", metavar="FOLDER", help="keep pictures of every page of the dashboard there")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out what takes seconds to import where none of its tests is asked for."""
    unasked = config.getoption("markexpr") == "not slow"
    return True if unasked and collection_path == Path(__file__).parent / "service/fuzz" else None


def room(test: str) -> str:
    """What a test is of: the beginning of its path that is in TOGETHER, else its file."""
    return next((start for start in TOGETHER if test.startswith(start)), test.partition("::")[0])


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Choose cases, and begin with what takes long."""
    mark_repetitions(items)
    order = {name: place for place, name in enumerate(TOGETHER)}
    items.sort(key=lambda item: order.get(room(item.nodeid), len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand out whole rooms, for `pytest -n 2 --dist loadfile`."""
    from xdist.scheduler import LoadScopeScheduling

    class Rooms(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return room(nodeid)

    return Rooms(config, log) if config.getvalue("dist") == "loadfile" else None
