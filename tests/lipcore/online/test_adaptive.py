"""Tests of the adaptive scale of intervals: coverage, reaction time and storage."""

import json

import numpy as np
import pytest

from lipcore.online import adaptive
from lipcore.online.adaptive import AdaptiveScale, outside, scores, widest

RATE, BATCH = 100.0, 10
ROWS_PER_MINUTE = 6000


def run_scale(score, batch=BATCH, rate=RATE, delay=0):
    """Return which rows were outside their intervals, the scales applied, and the final state."""
    state, missed, factors = AdaptiveScale.start(np.ones(score.shape[1])), [], []
    waiting = [state.factor] * (delay + 1)
    for first in range(0, len(score), batch):
        part = score[first : first + batch]
        missed.append(outside(part, waiting[0]))
        factors.append(np.broadcast_to(waiting[0], part.shape))
        state = state.step(np.arange(first, first + len(part)) / rate, part, waiting[0])
        waiting = [*waiting[1:], state.factor]
    return np.concatenate(missed), np.concatenate(factors), state


def assert_near_five_percent(missed, rows=ROWS_PER_MINUTE):
    """Assert a share of misses of 3 to 7 % in every window of `rows` rows."""
    sums = np.concatenate([np.zeros((1, missed.shape[1])), np.cumsum(missed, axis=0)])
    share = (sums[rows:] - sums[:-rows]) / rows
    assert share.min() > 0.03
    assert share.max() < 0.07


def adversarial_scores(seed, rows=4 * ROWS_PER_MINUTE):
    """Return scores of several kinds, one per column.

    The columns are noise of a wandering level, waves, steps by 100, random steps by 10, and plain noise.
    """
    rng, t = np.random.default_rng(seed), np.arange(rows) / RATE
    noise = np.abs(rng.standard_normal((rows, 4))) / 1.96
    level = np.exp(np.clip(np.cumsum(rng.standard_normal(rows)) * 0.02, -1.0, 4.0))
    waves = np.abs(np.sin(2 * np.pi * t / 3.0)) * (1 + 4 * (t % 60 > 30))
    steps = np.where((t // 40) % 2 == 1, 100.0, 1.0)
    bursts = np.where(rng.random(rows // 500).repeat(500) < 0.3, 0.3, 3.0)
    return np.column_stack([noise[:, 0] * level, waves, noise[:, 1] * steps, noise[:, 2] * bursts, noise[:, 3]])


@pytest.mark.parametrize("seed", [100, 101])
def test_misses_stay_near_five_percent_every_minute(seed):
    assert_near_five_percent(run_scale(adversarial_scores(seed))[0])


def test_misses_stay_near_five_percent_against_an_adversary():
    """Scores lie just outside for 3 s, then far inside until the scale is back."""
    state, missed, now, hurting = AdaptiveScale.start(np.ones(1)), [], 0.0, True
    for _ in range(4 * ROWS_PER_MINUTE // BATCH):
        part = np.full((BATCH, 1), state.factor[0] * (1.01 if hurting else 0.1))
        missed.append(outside(part, state.factor))
        now += BATCH / RATE
        state = state.step(now - np.arange(BATCH)[::-1] / RATE, part)
        hurting = (state.log[0] < 1.0) if hurting else (state.log[0] < -1.0)
    assert_near_five_percent(np.concatenate(missed))


def test_jump_by_a_hundred_is_covered_after_one_batch():
    score = np.abs(np.random.default_rng(3).standard_normal((400, 3))) / 1.96
    score[200:] *= 100.0
    missed, factors, _ = run_scale(score)
    assert missed[200:210].mean() > 0.9
    assert missed[210:230].mean() < 0.15
    assert (factors[-1] < 600).all()  # and not absurdly wide


def test_scale_falls_within_seconds():
    score = np.full((3000, 1), 0.2)
    score[:30] = 20.0
    _, factors, _ = run_scale(score)
    assert factors[40, 0] >= 20.0
    assert factors[1500, 0] < 1.0  # 15 s later


@pytest.mark.parametrize(("rate", "batch"), [(10.0, 1), (100.0, 5), (1000.0, 100)])
def test_coverage_does_not_depend_on_the_rate(rate, batch):
    rows = round(180 * rate)
    level = 0.3 + 2 * (np.arange(rows) / rate > 90)[:, None]
    score = np.abs(np.random.default_rng(5).standard_normal((rows, 1))) * level
    assert_near_five_percent(run_scale(score, batch, rate)[0], round(60 * rate))


def test_long_batch_leaves_a_debt():
    options = adaptive.OPTIONS
    state = AdaptiveScale.start(np.ones(1)).step(np.arange(500) / RATE, np.full((500, 1), 3.0))
    assert state.log[0] == pytest.approx(np.log(3.0 * options.margin))
    owed = min(0.95 * 500 / RATE * options.rate - state.log[0], options.max_owed)
    assert state.owed[0] == pytest.approx(owed, rel=0.01)
    still = state.step(5.0 + np.arange(1, 11) / RATE, np.full((10, 1), 0.1))  # they stand for 0.11 s
    assert still.log[0] == pytest.approx(state.log[0])
    assert still.owed[0] == pytest.approx(state.owed[0] - 0.055)


def test_late_frames_count_by_their_own_scale():
    state = AdaptiveScale(np.log([4.0]), np.zeros(1), 0.0)
    time = np.arange(1, 11) / RATE
    late = state.step(time, np.full((10, 1), 3.0), np.ones((10, 1)))
    now = state.step(time, np.full((10, 1), 3.0))
    assert late.log[0] > state.log[0] > now.log[0]


def test_rows_without_times_count_with_the_usual_step():
    score = np.full((1, 1), 5.0)
    at_once = AdaptiveScale.start(np.ones(1)).step(np.full(1, 7.0), score)
    assert at_once.log[0] == pytest.approx(0.95 * adaptive.OPTIONS.rate * adaptive.OPTIONS.usual_step_s)
    paused = at_once.step(np.full(1, 1000.0), score)
    assert paused.log[0] - at_once.log[0] == pytest.approx(at_once.log[0])
    assert paused.step(np.empty(0), np.empty((0, 1))) is paused


def test_state_is_stored_exactly():
    _, _, state = run_scale(adversarial_scores(7, 1000))
    again = AdaptiveScale.from_json(json.loads(json.dumps(state.to_json())))
    for name in ("log", "owed", "last"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))


def test_scores_and_widest_scale():
    assert scores(np.array([[-1.959963984540054]]), np.array([[0.6]]), np.array([0.8])) == pytest.approx(1.0)
    streams = [np.array([0.5, 3.0, 1.5]), np.array([0.7, 2.0, 1.2])]
    assert widest(streams, np.array([1.0, 1.0, 2.0])).tolist() == [1.0, 3.0, 2.0]
