"""Metrics against values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lipcore.data.metrics import LEVELS, RELIABILITY_LEVELS, evaluate

Z95 = 1.959963984540054


def test_all_figures_equal_hand_computed_values() -> None:
    tau = np.array([[1.0], [3.0], [5.0], [7.0]])
    mean = tau - np.array([[0.0], [1.0], [-1.0], [2.0]])
    std, noise = np.full((4, 1), 0.3), np.array([0.4])  # total 0.5
    answer = evaluate(tau, mean, std, noise)
    assert answer.nmse[0] == pytest.approx(1.5 / 5.0)
    assert answer.rmse[0] == pytest.approx(math.sqrt(1.5))
    assert answer.coverage[0] == 0.25  # the half width is 0.98: an error of 1 is outside
    assert answer.width[0] == pytest.approx(2 * Z95 * 0.5)
    assert answer.nlpd[0] == pytest.approx(0.5 * math.log(2 * math.pi * 0.25) + 0.5 * 1.5 / 0.25)
    assert answer.level == 0.95


def test_joints_are_judged_apart_and_noise_may_differ_by_sample() -> None:
    tau = np.array([[0.0, 0.0], [2.0, 2.0]])
    mean = tau + np.array([[1.0, 0.0], [1.0, 0.0]])
    answer = evaluate(tau, mean, np.zeros((2, 2)), np.array([[0.6, 1.0], [0.4, 1.0]]))
    assert answer.nmse.tolist() == [1.0, 0.0]
    assert answer.coverage.tolist() == [0.5, 1.0]


def gaussian(confidence: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Torques, means, and stds that are too small by the factor `confidence`."""
    rng = np.random.default_rng(1)
    std, noise = rng.uniform(0.1, 2.0, (20_000, 2)), np.array([0.5, 1.5])
    mean = rng.normal(size=std.shape)
    tau = mean + np.sqrt(std**2 + noise**2) * rng.standard_normal(std.shape)
    return tau, mean, std / confidence, noise / confidence


def test_calibrated_intervals_cover_what_they_promise_at_every_level() -> None:
    answer = evaluate(*gaussian())
    atol = 4 * math.sqrt(0.25 / 20_000)
    assert np.allclose(answer.coverages, np.array(LEVELS)[:, None], atol=atol)
    assert np.allclose(answer.reliability, np.array(RELIABILITY_LEVELS)[:, None], atol=atol)
    assert answer.coverages[LEVELS.index(0.95)].tolist() == answer.coverage.tolist()
    assert answer.widths[LEVELS.index(0.95)].tolist() == answer.width.tolist()


def test_overconfident_intervals_cover_less_at_every_level_and_timid_ones_more() -> None:
    true, proud, timid = evaluate(*gaussian()), evaluate(*gaussian(2.0)), evaluate(*gaussian(0.5))
    for name in ("coverages", "reliability"):
        assert (getattr(proud, name) < getattr(true, name)).all()
        assert (getattr(timid, name) > getattr(true, name)).all()
    assert np.allclose(proud.widths * 2, true.widths)


# the mean of seven times 0.1 is not 0.1: a variance by formula is not exactly zero
@pytest.mark.parametrize("constant", [0.0, 2.0, 0.1, 1.7])
def test_nmse_of_a_torque_that_does_not_vary_is_nan(constant: float) -> None:
    tau = np.full((7, 1), constant)
    answer = evaluate(tau, tau + 0.1, np.ones((7, 1)), np.ones(1))
    assert np.isnan(answer.nmse[0])
    assert answer.rmse[0] == pytest.approx(0.1)


@pytest.mark.parametrize(("mean", "std"), [((3, 2), (4, 2)), ((4, 2), (4, 1)), ((4,), (4, 2))])
def test_differing_shapes_are_named(mean: tuple[int, ...], std: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(4, 2\) as tau has"):
        evaluate(np.zeros((4, 2)), np.zeros(mean), np.zeros(std), np.ones(2))
