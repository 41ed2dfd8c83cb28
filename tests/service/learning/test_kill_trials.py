"""Kills at random moments while batches come: nothing acknowledged is lost, and nothing is learnt twice."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.latency import table as bench_table
from benchmarks.online import durability
from benchmarks.online.durability import VICTIMS, grids, open_trials, targets
from benchmarks.online.trials import BATCHES, Tally

TRIALS = 6
"""Kills, of the service and of its learner in turn."""


@pytest.fixture(scope="module")
def tally(tmp_path_factory) -> Tally:
    with open_trials(tmp_path_factory.mktemp("trials"), TRIALS, seed=5, batches=20) as trials:
        for number in range(TRIALS):
            trials.trial(VICTIMS[number % 2], batches=20)
        trials.weigh()
    return trials.tally


@pytest.mark.slow
def test_no_acknowledged_batch_is_lost(tally):
    assert tally.kills == {"service": TRIALS // 2, "learner": TRIALS // 2}
    assert tally.batches == 20 * TRIALS
    assert tally.lost == 0


@pytest.mark.slow
def test_no_batch_is_applied_twice(tally):
    assert tally.repeated > 0
    assert tally.late > 0
    assert tally.twice == 0


@pytest.mark.slow
def test_what_is_learnt_is_what_was_sent(tally):
    assert tally.refused == 0
    # a single batch more or less would show
    assert tally.largest <= durability.TOLERANCE < 0.1 * tally.one_batch


def test_a_plan_sends_everything_some_of_it_late_or_twice(tmp_path):
    trials = open_trials(tmp_path, 1, seed=1)
    plan = trials._plan(40, BATCHES)
    assert sorted(set(plan)) == list(range(40, 40 + BATCHES))
    assert len(plan) == BATCHES + trials.tally.repeated > BATCHES
    assert 0 < trials.tally.late <= sum(one > other for one, other in pairwise(plan))
    assert np.abs(np.array(list(dict.fromkeys(plan))) - np.arange(40, 40 + BATCHES)).max() < BATCHES


def test_the_tally_tells_what_was_broken():
    whole = Tally({"service": 50, "learner": 50}, batches=3000, largest=2e-10, one_batch=1e-5)
    assert [each.met for each in targets(whole)] == [True, True, True, None]
    broken = Tally({"service": 50, "learner": 50}, batches=3000, lost=1, twice=2, largest=1e-4, one_batch=1e-5)
    assert [each.met for each in targets(broken)] == [False, False, False, None]
    said = bench_table.grids_markdown(grids(broken), [durability.SAID])
    for text in ("| kills of the service | 50 |", "3,000", "NOT met", "1.0e-04"):
        assert text in said
