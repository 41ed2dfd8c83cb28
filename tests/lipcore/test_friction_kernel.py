"""Friction: independent per joint, linear in speed, direction and a constant."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lipcore.data.motion import Motion
from lipcore.kernels.friction import SIGN_WIDTH, STRIBECK_SPEED, FrictionKernel, friction_features
from tests.lipcore.problems import random_problem


def features(speed: float) -> list[float]:
    sign = math.tanh(speed / SIGN_WIDTH)
    return [speed, sign, 1.0, sign * math.exp(-((speed / STRIBECK_SPEED) ** 2))]


@pytest.mark.parametrize("terms", [3, 4])
def test_block_is_the_covariance_of_independent_weights_on_the_features(terms: int) -> None:
    motion = random_problem(("revolute", "prismatic", "revolute"), samples=4, seed=1).motion
    std = torch.exp(torch.from_numpy(np.random.default_rng(1).normal(size=(3, terms))))
    motion = Motion(motion.q, 0.02 * motion.dq, motion.ddq)  # slow enough for the sign to turn over
    kernel = FrictionKernel(3, terms == 4)
    gram = kernel.gram({"friction.log_std": torch.log(std)}, motion, motion).reshape(4, 3, 4, 3)
    for x in range(4):
        for y in range(4):
            for i in range(3):
                for j in range(3):
                    one, two = features(float(motion.dq[x, i])), features(float(motion.dq[y, j]))
                    expected = sum(float(std[i, f]) ** 2 * one[f] * two[f] for f in range(terms)) if i == j else 0.0
                    assert math.isclose(float(gram[x, i, y, j]), expected, rel_tol=1e-12, abs_tol=1e-14)


@pytest.mark.parametrize("stribeck", [False, True])
def test_compiled_features_are_those_of_the_kernel(stribeck: bool) -> None:
    motion = random_problem(("revolute",) * 3, samples=20, seed=3).motion
    motion = Motion(motion.q, 0.1 * motion.dq, motion.ddq)
    kernel = FrictionKernel(3, stribeck)
    regressor, asked = kernel.regressor(), motion.arrays()
    out = np.full((regressor.size, 3), np.nan)
    for query, expected in zip(asked, kernel.features(motion).numpy(), strict=True):
        regressor.fill(query, out)
        np.testing.assert_allclose(out.T, expected, rtol=1e-12, atol=1e-15)


def test_friction_of_slow_joints_fades() -> None:
    fourth = friction_features(torch.tensor([0.05, STRIBECK_SPEED, 1.0]).double(), stribeck=True)[3]
    assert fourth[0] > 2 * fourth[1] > 0.7
    assert fourth[2] < 1e-12


def test_sign_is_smooth_at_standstill_and_full_beyond() -> None:
    sign = friction_features(torch.tensor([-1.0, -5 * SIGN_WIDTH, 0.0, 5 * SIGN_WIDTH, 1.0]).double())[1]
    assert sign[2] == 0
    assert torch.allclose(sign[[0, 1, 3, 4]], torch.tensor([-1.0, -1.0, 1.0, 1.0]).double(), rtol=0, atol=1e-4)


def test_initial_hyperparameters_split_a_tenth_of_the_torque_over_features() -> None:
    motion = random_problem(("revolute",) * 2, samples=200, seed=2).motion
    tau = torch.stack([5 * motion.q[:, 0], 0.1 * motion.q[:, 1]], dim=1)
    std = torch.exp(FrictionKernel(2, stribeck=True).initial(motion, tau)["friction.log_std"])
    usual_speed = motion.dq.square().mean(0).sqrt()
    assert std.shape == (2, 4)
    assert torch.allclose(std[:, 0] * usual_speed, 0.1 * tau.square().mean(0).sqrt(), rtol=1e-12)
    assert torch.allclose(std[:, 1:], 0.1 * tau.square().mean(0).sqrt()[:, None].expand(2, 3), rtol=1e-12)
