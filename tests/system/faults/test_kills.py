"""Kills at named points: acknowledged writes survive, and no write is partial or duplicated."""

from collections.abc import Callable, Iterator
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

from tests.system.faults.actions import Train
from tests.system.faults.harness import FaultHarness
from tests.system.faults.points import FAULTS, FIRST_STARTS, POINTS, STARTS, TARGETS

ALWAYS = ("upload: file complete, no row",)
"""Points that are not marked slow."""


class HarnessPool:
    """Gives each trial a harness; a new one only after a failure."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._count = folder, 0
        self._harness: FaultHarness | None = None

    def run_trial(self, run: Callable[[FaultHarness], None]) -> None:
        """Run a function on a harness."""
        if self._harness is None:
            self._count += 1
            self._harness = FaultHarness(self.folder / str(self._count), TARGETS).__enter__()
        try:
            run(self._harness)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the service."""
        if self._harness is not None:
            self._harness.__exit__()
        self._harness = None


@pytest.fixture(scope="module")
def harness_pool(tmp_path_factory) -> Iterator[HarnessPool]:
    made = HarnessPool(tmp_path_factory.mktemp("faults"))
    yield made
    made.close()


@pytest.mark.parametrize(
    "point",
    [pytest.param(each, id=each.name, marks=[] if each.name in ALWAYS else [pytest.mark.slow]) for each in POINTS],
)
def test_kill_keeps_acknowledged_writes_and_no_partial_ones(harness_pool, point):
    def run(harness: FaultHarness) -> None:
        action = point.action()
        if not harness.inject(point.fault, action.request):  # an answered request is in the ledger already
            assert action.check_outcome(harness) == (point.left == "all")
        harness.verify()

    harness_pool.run_trial(run)


@pytest.mark.parametrize("fault", STARTS.values(), ids=STARTS)
def test_restart_recovers_from_kill_during_start(harness_pool, fault):
    """There is a job to restart and a file to delete."""

    def run(harness: FaultHarness) -> None:
        Train().request(harness)
        (harness.home / "uploads" / "half").write_bytes(b"PK")
        harness.inject_at_start(fault)
        harness.verify()

    harness_pool.run_trial(run)


@pytest.mark.parametrize("fault", FIRST_STARTS.values(), ids=FIRST_STARTS)
def test_restart_recovers_from_kill_during_first_start(tmp_path, fault):
    harness = FaultHarness(tmp_path, TARGETS, populated=False)
    harness.injector.arm(fault, 0)
    with pytest.raises(AssertionError):
        harness.start()
    assert harness.injector.happened() is not None
    harness.injector.disarm()
    with harness:
        harness.verify()
        Train().request(harness)
        harness.verify()


@pytest.mark.parametrize("function", sorted(TARGETS | {fault.within for fault in FAULTS if fault.within}))
def test_fault_targets_exist(function):
    module, _, path = function.partition(":")
    assert callable(attrgetter(path)(import_module(module)))


def test_fault_points_have_unique_names():
    assert len({point.name for point in POINTS}) == len(POINTS)
    assert set(ALWAYS) <= {point.name for point in POINTS}
