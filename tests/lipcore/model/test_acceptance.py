"""Tests of acceptance: a model passes if its error and coverage are surely good enough."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.signals import noise_level
from lipcore.model import texts
from lipcore.model.acceptance import OPTIONS, HeldOutFigures, accept

GOOD_FIGURES = HeldOutFigures(
    joint_names=("hip", "knee"),
    nmse=np.array([0.01, 0.2]),
    rmse=np.array([0.1, 1.0]),
    torque_noise=np.full(2, 0.05),
    coverage=np.array([0.95, 0.96]),
    coverage_high=np.array([0.97, 0.98]),
    independent=np.full(2, 60.0),
    interval_width=np.array([0.5, 5.0]),
)


def accept_with(**fields):
    return accept(replace(GOOD_FIGURES, **{name: np.array(value) for name, value in fields.items()}))


def test_good_model_passes_with_reasons():
    assert accept(GOOD_FIGURES).passed is True
    assert accept(GOOD_FIGURES).reason == (
        "the error is at most 0.2 of the torque's variance; coverage of the 95 % intervals is at least 90 % on every "
        "joint, within sampling error"
    )


@pytest.mark.parametrize("nmse", [OPTIONS.max_error, 1.0, 14.0])
def test_error_like_that_of_the_mean_fails(nmse):
    found = accept_with(nmse=[0.01, nmse], rmse=[0.1, 1.0])
    assert found.passed is False
    assert found.reason.startswith(
        f"the error is not below that of the mean torque: knee at {nmse:.2g} of the variance (60"
    )


def test_few_errors_are_inconclusive():
    few = accept_with(independent=[60.0, 4.0])
    assert few.passed is None
    assert few.unknown == (
        "too few samples are held out to compare the error with that of the mean torque: knee at 0.2 of the variance "
        "(4 effective samples)",
    )
    assert accept_with(independent=[60.0, 8.0]).passed is True


def test_torque_of_mostly_noise_needs_no_explanation():
    spread = 1.0 / np.sqrt(1.1)
    assert accept_with(nmse=[0.01, 1.1], torque_noise=[0.05, 1.01 * spread / OPTIONS.min_signal]).passed is True
    assert accept_with(nmse=[0.01, 1.1], torque_noise=[0.05, 0.99 * spread / OPTIONS.min_signal]).passed is False
    assert accept_with(nmse=[0.01, np.nan]).passed is True
    assert accept_with(nmse=[np.nan, np.nan]).unknown == (texts.NO_SIGNAL,)


def test_low_coverage_fails_unless_due_to_chance():
    assert accept_with(coverage=[0.95, 0.7]).passed is True
    narrow = accept_with(coverage=[0.95, 0.7], coverage_high=[0.97, 0.89])
    assert narrow.passed is False
    assert "95 % intervals is below 90 %: knee at 70 % (at most 89 %, 60 effective samples)" in narrow.reason


def test_wide_intervals_are_noted():
    wide = accept_with(interval_width=[0.5, 12.0])
    assert wide.passed is True
    assert wide.reason.endswith("; the 95 % intervals are wider than the errors need: knee at 3.1 times")
    assert accept_with(rmse=[0.0, 1.0], nmse=[0.0, 0.2]).notes == ()


@pytest.mark.parametrize("seed", range(5))
def test_mean_and_shuffled_torque_never_pass(seed):
    """Test a model that predicts the mean, with few effective samples, and one trained on shuffled torque."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 50
    tau = np.sin(np.outer(t, rng.uniform(1, 6, 3)) + rng.uniform(0, 6, 3)) * [5.0, 1.0, 30.0]
    tau += 0.02 * rng.standard_normal(tau.shape)
    error = tau - tau.mean(axis=0) + 0.1 * rng.standard_normal(3)
    for torque in (tau, tau[rng.permutation(len(tau))]):
        figures = HeldOutFigures(
            ("a", "b", "c"),
            np.mean(error**2, axis=0) / torque.var(axis=0),
            np.sqrt(np.mean(error**2, axis=0)),
            noise_level([torque]),
            *(np.full(3, value) for value in (1.0, 1.0, 20.0, 9.0)),
        )
        assert accept(figures).passed is not True
