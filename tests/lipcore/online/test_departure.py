"""Tests that labels that follow the model's predictions are detected, and honest labels are not."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from lipcore.online.changes.departure import OPTIONS, Departure
from tests.choosing import slow

ROWS_PER_HOUR = 36_000
"""Rows of an hour at 10 Hz, each a full effective sample."""
NOISE = np.array([0.05, 0.2])


START = Departure.start(1, 2)


def step(state, error, std=0.0, weight=1.0, at=0.0):
    error = np.asarray(error)
    count = len(error)
    return state.step(at + np.arange(count), np.full(count, weight), error, np.broadcast_to(std, error.shape), NOISE)


def biased(rows, first, second=0.0):
    """Return constant errors of both joints, in standard deviations of the noise."""
    return np.tile([first, second], (rows, 1)) * NOISE


@pytest.mark.parametrize("seed", [0, slow(1), slow(2)])
@pytest.mark.parametrize("bias", [0.0, 1.0, -1.0])
@pytest.mark.parametrize("persist", [0, 3])
def test_honest_labels_raise_no_alarm_for_an_hour(seed, bias, persist):
    """The function's error, within its std, lasts for the hour; noise may be correlated over some rows."""
    white = np.random.default_rng(seed).standard_normal((ROWS_PER_HOUR, 2))
    if persist:
        keep = np.exp(-1 / persist)
        white = lfilter([np.sqrt(1 - keep**2)], [1, -keep], white, axis=0)
    std = 0.5 * NOISE
    assert step(START, NOISE * white + bias * std, std).level.max() < OPTIONS.bound


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_lasting_excess_errors_add_up(sign):
    """An error of one standard deviation adds 1 − slack per row, less the function's stated share."""
    state = Departure.start(3, 2)
    for count in range(1, 101):
        state = step(state, biased(1, sign), at=float(count))
        gained = (1 - OPTIONS.slack) * count
        assert state.level == pytest.approx([gained, 0.0])
        assert bool(state.joints) is (gained > OPTIONS.bound) or gained == pytest.approx(OPTIONS.bound)
    assert (state.joints, state.began, state.drift[0]) == ((0,), 1.0, pytest.approx(sign))
    assert state.evidence(("a", "b")) == {
        "cause": "drift against the trained version",
        "trained": {"version": 3, "drift": {"a": state.drift[0]}},
    }
    stated = step(Departure.start(3, 2), biased(200, sign), std=NOISE)  # a wide interval allows as much
    assert stated.level.max() == 0.0


def test_fast_streams_count_by_time():
    """A thousand rows per second are ten effective samples, in batches or row by row."""
    error = biased(1000, 1.0, 1.0)
    at_once, one_by_one = step(START, error, weight=0.01), START
    assert at_once.level == pytest.approx([5.0, 5.0])
    for row in error:
        one_by_one = step(one_by_one, row[None], weight=0.01)
    assert one_by_one.level == pytest.approx(at_once.level)


def test_few_distant_rows_are_left_to_the_gates():
    assert step(START, np.full((5, 2), 1e6)).joints == ()


def test_decision_sets_the_new_centre():
    state = step(START, biased(100, 2.0))
    assert state.joints == (0,)
    decided = state.decided()
    assert decided.joints == ()
    assert decided.centre == pytest.approx([2.0, 0.0])
    assert step(decided, biased(1000, 2.0)).level.max() == pytest.approx(0.0, abs=1e-9)
    assert step(decided, biased(1000, 0.0)).joints == (0,)  # a return is a departure, too


def test_second_change_retires_the_reference():
    state = step(START, biased(20, 2.0)).decided()
    assert state.retired
    assert step(state, biased(1000, 2.0)) is state
    assert Departure.from_json(state.to_json()).retired


def test_state_is_stored_exactly():
    error = NOISE * (np.random.default_rng(8).standard_normal((900, 2)) + 0.4)
    state = step(Departure.start(7, 2), error[:450], weight=0.3)
    stored = Departure.from_json(json.loads(json.dumps(state.to_json())))
    one, other = (step(each, error[450:], weight=0.3, at=450.0) for each in (state, stored))
    assert one.to_json() == other.to_json()
