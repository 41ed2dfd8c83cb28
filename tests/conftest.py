"""Settings of the test suite: the tests of `make test`, and which tests share a process in parallel runs."""

import ast
import gc
import re
import threading
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests import ROOT
from tests.choosing import mark_repetitions

_parse, _parsing = ast.parse, threading.RLock()


def _parse_alone(*args: Any, **options: Any) -> ast.AST:
    """Parse as `ast.parse` does: in Python 3.11, two threads that parse at a time may fail (gh-106905)."""
    with _parsing:
        return _parse(*args, **options)


ast.parse = _parse_alone  # type: ignore[assignment]

# derandomised, so that a failure on one machine is a failure on every machine
settings.register_profile("lipserve", derandomize=True, deadline=None, max_examples=10)
settings.register_profile("thorough", settings.get_profile("lipserve"), max_examples=100)  # of `make test-all`
settings.load_profile("lipserve")

SYSTEM = ("tests/system/", "tests/attack/", "tests/year/", "tests/clients/cpp/", "tests/clients/ros2/")
"""Folders of tests with real services, browsers, compilers, PostgreSQL, Dask and power cuts.

`make test` runs their tests with the marker `journey`, `make test-all` runs all.
"""
STREAMING = "tests/service/api/stream/"
"""Group of tests with the fixture `streaming`, a service that takes seconds to start."""
IN_GROUP = {f"tests/service/inference/test_{name}.py": STREAMING for name in ("external", "fallback")}
"""Groups of files elsewhere."""
GROUP_PREFIXES = (
    "tests/system/browser/",
    "tests/system/cluster/",
    "tests/docs/",
    "tests/clients/",
    STREAMING,
    "tests/service/cli/",
)
"""Path prefixes of tests that share a slow start, so that each group runs in one process. The slowest come first, as
other processes would wait for a slow group that begins late."""
_ONLY_SLOW = re.compile(r"^pytestmark = .*mark\.slow", re.MULTILINE)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options for the storage of services and for a folder of pictures."""
    parser.addoption(
        "--backend",
        choices=("own", "shared"),
        default="own",
        help="own: SQLite and files of each service (the default); shared: PostgreSQL and S3, started by the tests",
    )
    parser.addoption("--pictures", metavar="FOLDER", help="keep pictures of every page of the dashboard there")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Ignore modules with slow tests only unless these are selected: `make test` lacks packages that they import."""
    if config.getoption("markexpr") != "not slow" or (collection_path.is_file() and collection_path.suffix != ".py"):
        return None
    modules = list(collection_path.rglob("test_*.py")) if collection_path.is_dir() else [collection_path]
    return True if modules and all(map(_is_slow, modules)) else None


@cache
def _is_slow(module: Path) -> bool:
    text, name = module.read_text("utf-8"), module.relative_to(ROOT).as_posix()
    return bool(_ONLY_SLOW.search(text)) or (name.startswith(SYSTEM) and "mark.journey" not in text)


def group_of(test: str) -> str:
    """Return the group of a test: that of IN_GROUP, its path prefix in GROUP_PREFIXES, or its file."""
    file = test.partition("::")[0]
    return IN_GROUP.get(file) or next((start for start in GROUP_PREFIXES if test.startswith(start)), file)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests, and run the slowest groups first."""
    mark_repetitions(items)
    for item in items:
        if item.nodeid.startswith(SYSTEM) and item.get_closest_marker("journey") is None:
            item.add_marker(pytest.mark.slow)
    order = {name: place for place, name in enumerate(GROUP_PREFIXES)}
    items.sort(key=lambda item: order.get(group_of(item.nodeid), len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute whole groups, for `pytest -n 2 --dist loadfile`."""
    from xdist.scheduler import LoadScopeScheduling

    class GroupScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid)

    return GroupScheduling(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_finish() -> None:
    """Keep what was collected from the garbage collector, which would look through it again and again."""
    gc.freeze()
