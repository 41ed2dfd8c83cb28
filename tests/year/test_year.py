"""A year of a laboratory: nothing grows without a bound, nothing is lost, and every counter means what it says.

LIPSERVE_YEAR_DAYS and LIPSERVE_YEAR_ROBOTS: length of the simulated time and number of robots; LIPSERVE_YEAR_SEED: its
seed, by default a new one for each run, which the test prints.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from tests.system.histories.clock import Clock
from tests.year.happenings import OTHERS, RESTARTS
from tests.year.laboratory import Laboratory
from tests.year.sizes import find_growth, format_table

DAYS, ROBOTS = int(os.environ.get("LIPSERVE_YEAR_DAYS", "30")), int(os.environ.get("LIPSERVE_YEAR_ROBOTS", "3"))
SEED = int(os.environ.get("LIPSERVE_YEAR_SEED", str(time.time_ns() % 10**6)))
PERIOD = 5
"""Days between two measurements of sizes. Every third period is without restarts, so that leaks show."""
CHECK = 30
"""Days between two checks of everything stored."""


def plan_days(random: Random, days: int) -> Iterator[list[Callable[[Laboratory], None]]]:
    """Yield what happens on each day: all kinds in turn, in random order, about two a day."""
    deck: list[Callable[[Laboratory], None]] = []
    for day in range(days):
        calm = day // PERIOD % 3 == 2
        chosen = [] if calm or random.random() < 0.5 else [random.choice(RESTARTS)]
        while len(chosen) < 2:
            if not deck:
                deck = random.sample(OTHERS, len(OTHERS))
            chosen.append(deck.pop())
        yield chosen


@pytest.mark.skipif(not Clock.movable, reason="without a C compiler the clock cannot be moved")
def test_year_leaves_no_trace(tmp_path: Path) -> None:
    periods, days = [], []
    print(f"LIPSERVE_YEAR_SEED={SEED} LIPSERVE_YEAR_DAYS={DAYS} LIPSERVE_YEAR_ROBOTS={ROBOTS}")  # noqa: T201
    with Laboratory(tmp_path, ROBOTS, SEED) as lab:
        try:
            for plan in plan_days(Random(SEED), DAYS):
                lab.pass_day(plan)
                if lab.day % PERIOD == 0:
                    lab.settle()
                    days.append(lab.day)
                    periods.append(lab.measure())
                if lab.day % CHECK == 0 or lab.day == DAYS:
                    lab.check()
        finally:
            print({name: round(seconds) for name, seconds in lab.spent.most_common()})  # noqa: T201
            print(format_table(periods, days))  # noqa: T201
    assert find_growth(periods) == []
