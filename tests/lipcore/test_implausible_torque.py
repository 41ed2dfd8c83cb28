"""Torque that nobody has measured: zero against gravity, what the model answers, and what a drive repeats."""

import numpy as np
import pytest

from lipcore.online.gates import is_implausible

ROWS, JOINTS = 40, 3
NOISE = np.array([0.1, 0.05, 0.02])


def moving(seed=0):
    """The model's torque along a motion, and what an arm measures there."""
    phase = np.linspace(0, 3, ROWS)[:, None] + np.arange(JOINTS)
    mean = np.array([2.0, 1.0, 0.5]) * np.sin(phase)
    return mean, mean + NOISE * np.random.default_rng(seed).standard_normal(mean.shape)


def found(tau, mean, gravity=True):
    return is_implausible(np.asarray(tau, np.float64), mean, NOISE, gravity)


def test_what_an_arm_measures_is_plausible_whether_it_fits_or_not():
    mean, tau = moving()
    for measured in (tau, tau + 5.0, -tau, np.round(tau, 1), np.where(np.arange(JOINTS) == 1, 0.0, tau)):
        assert not found(measured, mean).any()


def test_zero_torque_is_measured_only_where_nothing_pulls():
    mean, tau = moving()
    assert found(np.zeros_like(tau), mean).all()
    tau[10:15] = 0.0
    assert np.flatnonzero(found(tau, mean)).tolist() == [10, 11, 12, 13, 14]
    assert not found(np.zeros((5, JOINTS)), 0.1 * NOISE * np.ones((5, 1))).any()
    tau[10:15] = 0.01 * np.arange(1, 6)[:, None]  # a sensor that wavers about it
    assert not found(tau, mean).any()


def test_without_gravity_an_arm_may_be_free_of_torque():
    mean, tau = moving()
    tau[10] = 0.0
    assert not found(tau, mean, gravity=False).any()


@pytest.mark.parametrize("late", [0, 1])
def test_what_the_model_answers_is_no_measurement(late):
    mean, tau = moving()
    assert found(np.roll(mean, late, axis=0), mean).all()
    tau[20:23] = mean[20 - late : 23 - late]
    assert np.flatnonzero(found(tau, mean)).tolist() == [20, 21, 22]


def test_torque_that_stands_still_while_the_arm_moves_is_no_measurement():
    mean, tau = moving()
    tau[5:12] = tau[5]
    assert np.flatnonzero(found(tau, mean)).tolist() == list(range(5, 12))
    assert not found(np.tile(tau[5], (7, 1)), np.tile(mean[5], (7, 1))).any()  # nor does the arm move


def test_where_most_rows_are_implausible_all_are():
    mean, tau = moving()
    tau[: ROWS // 2 + 1] = 0.0
    assert found(tau, mean).all()
    assert found(tau[:0], mean[:0]).shape == (0,)
