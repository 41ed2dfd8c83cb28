"""Remaining time of a fit: from its pace, on a made-up clock."""

from __future__ import annotations

import pytest

from lipcore.fitting.hyperparameters import FitProgress
from service.training.pulse import POSTERIOR_ITERATIONS, Remaining


def at(iteration, stage="hyperparameters", most=50):
    return FitProgress(stage, iteration, most, 0.0, 0.95 * iteration / most, 0.0)


def test_it_is_not_told_before_the_pace_is_known():
    left = Remaining(100, 100)
    assert left.seconds(0.0) is None
    for iteration in (1, 2):
        left.step(at(iteration), 2.0 * iteration)
        assert left.seconds(2.0 * iteration) is None
    left.step(at(3), 6.0)
    assert left.seconds(6.0) is not None


@pytest.mark.parametrize("ratio", [1, 2, 4])
def test_a_steady_search_counts_down_to_the_end(ratio):
    """The steps that follow the search cost as the cube of their samples."""
    left, after = Remaining(100, 100 * ratio), POSTERIOR_ITERATIONS * ratio**3
    for iteration in range(1, 51):
        left.step(at(iteration), 10.0 + 2.0 * iteration)
        if iteration >= 3:
            assert left.seconds(10.0 + 2.0 * iteration) == pytest.approx(2.0 * (50 - iteration + after))
    left.step(at(50, "posterior"), 110.0)
    assert left.seconds(111.0) == pytest.approx(2.0 * after - 1.0)


def test_a_search_that_ends_early_leaves_what_follows_it():
    left = Remaining(100, 200)
    for iteration in range(1, 11):
        left.step(at(iteration), float(iteration))
    assert left.seconds(10.0) == pytest.approx(40 + 8 * POSTERIOR_ITERATIONS)
    left.step(at(10, "posterior"), 10.0)
    assert left.seconds(10.0) == pytest.approx(8 * POSTERIOR_ITERATIONS)


def test_what_was_told_too_low_is_no_longer_told():
    left = Remaining(100, 100)
    for iteration in range(1, 5):
        left.step(at(iteration), float(iteration))
    left.step(at(4, "posterior"), 4.0)
    assert left.seconds(4.0) == pytest.approx(POSTERIOR_ITERATIONS)
    assert left.seconds(4.0 + POSTERIOR_ITERATIONS) is None


def test_a_fit_of_few_steps_tells_nothing():
    left = Remaining(100, 100)
    left.step(at(1), 1.0)
    left.step(at(2, "posterior"), 2.0)
    assert left.seconds(2.0) is None
