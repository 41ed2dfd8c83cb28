"""Processes of the service killed at named points: what was acknowledged is there, nothing is half or twice."""

from collections.abc import Callable, Iterator
from importlib import import_module
from operator import attrgetter
from pathlib import Path

import pytest

from tests.service.faults.actions import Train
from tests.service.faults.house import House
from tests.service.faults.points import FAULTS, FIRST_STARTS, POINTS, STARTS, TARGETS

ALWAYS = ("upload: file complete, no row",)
"""Points that every run of the tests looks at."""


class Street:
    """Houses for one trial after the other: the next house only where the last one has suffered a defect."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._houses = folder, 0
        self._house: House | None = None

    def trial(self, run: Callable[[House], None]) -> None:
        """Do something in a house."""
        if self._house is None:
            self._houses += 1
            self._house = House(self.folder / str(self._houses), TARGETS).__enter__()
        try:
            run(self._house)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the service."""
        if self._house is not None:
            self._house.__exit__()
        self._house = None


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Iterator[Street]:
    made = Street(tmp_path_factory.mktemp("faults"))
    yield made
    made.close()


@pytest.mark.parametrize(
    "point",
    [pytest.param(each, id=each.name, marks=[] if each.name in ALWAYS else [pytest.mark.slow]) for each in POINTS],
)
def test_what_was_acknowledged_is_there_and_nothing_is_half(street, point):
    def run(house: House) -> None:
        action = point.action()
        if not house.strike(point.fault, action.ask):  # else it was answered before, and is kept
            assert action.settle(house) == (point.left == "all")
        house.verify()

    street.trial(run)


@pytest.mark.slow
@pytest.mark.parametrize("fault", STARTS.values(), ids=STARTS)
def test_a_kill_while_the_service_starts_is_made_up_for_by_the_next_start(street, fault):
    """The start has a job to take up and a file to sweep."""

    def run(house: House) -> None:
        Train().ask(house)
        (house.home / "uploads" / "half").write_bytes(b"PK")
        house.strike_start(fault)
        house.verify()

    street.trial(run)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FIRST_STARTS.values(), ids=FIRST_STARTS)
def test_a_kill_at_the_very_first_start_leaves_a_home_that_the_next_one_can_use(tmp_path, fault):
    house = House(tmp_path, TARGETS, furnished=False)
    house.injector.arm(fault, 0)
    with pytest.raises(AssertionError):
        house.start()
    assert house.injector.happened() is not None
    house.injector.disarm()
    with house:
        house.verify()
        Train().ask(house)
        house.verify()


@pytest.mark.parametrize("function", sorted(TARGETS | {fault.within for fault in FAULTS if fault.within}))
def test_points_are_functions_that_there_are(function):
    module, _, path = function.partition(":")
    assert callable(attrgetter(path)(import_module(module)))


def test_every_point_has_a_name_of_its_own():
    assert len({point.name for point in POINTS}) == len(POINTS)
    assert set(ALWAYS) <= {point.name for point in POINTS}
