"""Tests of implausible torque: zeros against gravity, copied predictions, and repeated values."""

import numpy as np
import pytest

from lipcore.online.gates import is_implausible

ROWS, JOINTS = 40, 3
NOISE = np.array([0.1, 0.05, 0.02])


def simulate_torque(seed=0):
    """Return the model's torque along a motion, and the measured torque."""
    phase = np.linspace(0, 3, ROWS)[:, None] + np.arange(JOINTS)
    mean = np.array([2.0, 1.0, 0.5]) * np.sin(phase)
    return mean, mean + NOISE * np.random.default_rng(seed).standard_normal(mean.shape)


def check_torque(tau, mean, gravity=True):
    return is_implausible(np.asarray(tau, np.float64), mean, NOISE, gravity)


def test_measured_torque_is_plausible():
    mean, tau = simulate_torque()
    for measured in (tau, tau + 5.0, -tau, np.round(tau, 1), np.where(np.arange(JOINTS) == 1, 0.0, tau)):
        assert not check_torque(measured, mean).any()


def test_zero_torque_is_implausible_against_gravity():
    mean, tau = simulate_torque()
    assert check_torque(np.zeros_like(tau), mean).all()
    tau[10:15] = 0.0
    assert np.flatnonzero(check_torque(tau, mean)).tolist() == [10, 11, 12, 13, 14]
    assert not check_torque(np.zeros((5, JOINTS)), 0.1 * NOISE * np.ones((5, 1))).any()
    tau[10:15] = 0.01 * np.arange(1, 6)[:, None]  # a sensor that varies around zero
    assert not check_torque(tau, mean).any()


def test_zero_torque_is_plausible_without_gravity():
    mean, tau = simulate_torque()
    tau[10] = 0.0
    assert not check_torque(tau, mean, gravity=False).any()


@pytest.mark.parametrize("late", [0, 1])
def test_copied_predictions_are_implausible(late):
    mean, tau = simulate_torque()
    assert check_torque(np.roll(mean, late, axis=0), mean).all()
    tau[20:23] = mean[20 - late : 23 - late]
    assert np.flatnonzero(check_torque(tau, mean)).tolist() == [20, 21, 22]


def test_constant_torque_during_motion_is_implausible():
    mean, tau = simulate_torque()
    tau[5:12] = tau[5]
    assert np.flatnonzero(check_torque(tau, mean)).tolist() == list(range(5, 12))
    assert not check_torque(np.tile(tau[5], (7, 1)), np.tile(mean[5], (7, 1))).any()  # the arm rests, too


def test_mostly_implausible_rows_are_all_implausible():
    mean, tau = simulate_torque()
    tau[: ROWS // 2 + 1] = 0.0
    assert check_torque(tau, mean).all()
    assert check_torque(tau[:0], mean[:0]).shape == (0,)
