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


def with_rows(tau, first, values):
    """Return the torque with other values in the rows from `first` on."""
    return np.concatenate([tau[:first], values, tau[first + len(values) :]])


ZEROS = np.zeros((ROWS, JOINTS))
CASES = {
    "measured": (lambda tau, mean: tau, []),
    "biased": (lambda tau, mean: tau + 5.0, []),
    "of opposite sign": (lambda tau, mean: -tau, []),
    "rounded": (lambda tau, mean: np.round(tau, 1), []),
    "zero at one joint": (lambda tau, mean: np.where(np.arange(JOINTS) == 1, 0.0, tau), []),
    "zero": (lambda tau, mean: ZEROS, range(ROWS)),
    "zero for five rows": (lambda tau, mean: with_rows(tau, 10, ZEROS[:5]), range(10, 15)),
    "zero in most rows": (lambda tau, mean: with_rows(tau, 0, ZEROS[: ROWS // 2 + 1]), range(ROWS)),
    "varying around zero": (lambda tau, mean: with_rows(tau, 10, 0.01 * np.arange(1, 6)[:, None] + ZEROS[:5]), []),
    "copied": (lambda tau, mean: mean, range(ROWS)),
    "copied late": (lambda tau, mean: np.roll(mean, 1, axis=0), range(ROWS)),
    "copied for three rows": (lambda tau, mean: with_rows(tau, 20, mean[20:23]), [20, 21, 22]),
    "copied late for three rows": (lambda tau, mean: with_rows(tau, 20, mean[19:22]), [20, 21, 22]),
    "constant during motion": (lambda tau, mean: with_rows(tau, 5, np.tile(tau[5], (7, 1))), range(5, 12)),
}


@pytest.mark.parametrize("case", CASES)
def test_torque_that_cannot_be_measured_is_implausible(case):
    mean, tau = simulate_torque()
    change, expected = CASES[case]
    assert np.flatnonzero(is_implausible(change(tau, mean), mean, NOISE, gravity=True)).tolist() == list(expected)


def test_zero_torque_is_plausible_without_gravity():
    mean, tau = simulate_torque()
    assert not is_implausible(with_rows(tau, 10, ZEROS[:1]), mean, NOISE, gravity=False).any()
    assert not is_implausible(ZEROS[:5], 0.1 * NOISE * np.ones((5, 1)), NOISE, gravity=True).any()


def test_constant_torque_at_rest_is_plausible():
    mean, tau = simulate_torque()
    assert not is_implausible(np.tile(tau[5], (7, 1)), np.tile(mean[5], (7, 1)), NOISE, gravity=True).any()
    assert is_implausible(tau[:0], mean[:0], NOISE, gravity=True).shape == (0,)
