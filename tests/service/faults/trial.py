"""One fault at one point, and what is left afterwards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.service.faults.actions import train
from tests.service.faults.house import House
from tests.service.faults.injection import Fault
from tests.service.faults.points import TARGETS, Point


class Street:
    """Houses for one trial after the other: the next house only where the last one has suffered a defect."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.starts = folder, 0
        self._houses = 0
        self._house: House | None = None

    def trial(self, point: Point) -> str:
        """Let the fault of a point happen, and verify what the service knows then; say what was left."""
        return self._in_a_house(lambda house: _trial(house, point))

    def start_trial(self, fault: Fault) -> str:
        """Let a fault end a start that has a job to take up and a file to sweep; verify after the next start."""
        return self._in_a_house(lambda house: _start_trial(house, fault))

    def close(self) -> None:
        """End the service."""
        if self._house is not None:
            self.starts += self._house.starts
            self._house.__exit__()
        self._house = None

    def _in_a_house(self, run: Callable[[House], str]) -> str:
        if self._house is None:
            self._houses += 1
            self._house = House(self.folder / str(self._houses), TARGETS).__enter__()
        try:
            return run(self._house)
        except BaseException:
            self.close()
            raise


def first_start_trial(folder: Path, fault: Fault) -> str:
    """Let a fault end the very first start; verify after the next one."""
    house = House(folder, TARGETS, furnished=False)
    house.injector.arm(fault, 0)
    with pytest.raises(AssertionError):
        house.start()
    assert house.injector.happened() is not None
    house.injector.disarm()
    with house:
        house.verify()
        train().ask(house)
        house.verify()
    return "whole after the next start"


def _trial(house: House, point: Point) -> str:
    action, starts = point.action(), house.starts
    answered = house.strike(point.fault, action.ask)
    if answered:
        said = "answered before, and kept"
    else:
        found = action.settle(house)
        assert found == (point.left == "all"), f"{'all' if found else 'nothing'} is left, expected {point.left}"
        said = "not answered, but whole" if found else "not answered, nothing left"
    house.verify()
    return f"{said}; {'service started again' if house.starts > starts else 'service went on'}"


def _start_trial(house: House, fault: Fault) -> str:
    train().ask(house)
    (house.home / "uploads" / "half").write_bytes(b"PK")
    house.strike_start(fault)
    house.verify()
    return "whole after the next start"
