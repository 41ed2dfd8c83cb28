"""A model passes where its error is surely below the mean's and its intervals hold; what cannot be told is said."""

from dataclasses import replace

import numpy as np
import pytest

from lipcore.data.signals import noise_level
from lipcore.model.acceptance import OPTIONS, HeldOutFigures, accept

GOOD = HeldOutFigures(
    joint_names=("hip", "knee"),
    nmse=np.array([0.01, 0.2]),
    rmse=np.array([0.1, 1.0]),
    torque_noise=np.full(2, 0.05),
    coverage=np.array([0.95, 0.96]),
    coverage_high=np.array([0.97, 0.98]),
    independent=np.full(2, 60.0),
)


def changed(**fields):
    return accept(replace(GOOD, **{name: np.array(value) for name, value in fields.items()}))


def test_what_is_good_passes_and_says_how_good():
    assert accept(GOOD).passed is True
    assert accept(GOOD).reason.startswith(
        "its error is at most 0.2 of the variance of the torque; its 95 % intervals hold"
    )


@pytest.mark.parametrize("nmse", [OPTIONS.max_error, 1.0, 14.0])
def test_an_error_like_that_of_the_mean_fails(nmse):
    found = changed(nmse=[0.01, nmse], rmse=[0.1, 1.0])
    assert found.passed is False
    assert found.reason.startswith(
        f"its error is not below that of the mean torque: knee {nmse:.2g} of its variance (60"
    )


def test_few_errors_cannot_tell():
    few = changed(independent=[60.0, 4.0])
    assert few.passed is None
    assert few.unknown == (
        "too little was held out to tell its error from that of the mean: knee 0.2 of its variance (4 independent "
        "errors)",
    )
    assert changed(independent=[60.0, 8.0]).passed is True


def test_torque_that_is_mostly_noise_need_not_be_explained():
    spread = 1.0 / np.sqrt(1.1)
    assert changed(nmse=[0.01, 1.1], torque_noise=[0.05, 1.01 * spread / OPTIONS.min_signal]).passed is True
    assert changed(nmse=[0.01, 1.1], torque_noise=[0.05, 0.99 * spread / OPTIONS.min_signal]).passed is False
    assert changed(nmse=[0.01, np.nan]).passed is True
    assert changed(nmse=[np.nan, np.nan]).unknown == ("no torque of what was held out stands out of its noise",)


def test_intervals_that_hold_too_little_fail_unless_chance_explains_it():
    assert changed(coverage=[0.95, 0.7]).passed is True
    narrow = changed(coverage=[0.95, 0.7], coverage_high=[0.97, 0.89])
    assert narrow.passed is False
    assert (
        "hold less than 90 % of what was held out: knee 70 % (at most 89 %, from 60 independent errors)"
        in narrow.reason
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_mean_itself_and_shuffled_torque_never_pass(seed):
    """Of a model that answers the mean, with as few errors as the motion makes, and of one that was taught shuffled."""
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
            *(np.full(3, value) for value in (1.0, 1.0, 20.0)),
        )
        assert accept(figures).passed is not True
