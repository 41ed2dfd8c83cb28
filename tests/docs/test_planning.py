"""Tests of the example `docs/examples/planning.py`."""

import runpy

import jax
import numpy as np
import pytest
import torch

from lipcore import TorqueModel
from lipcore.export.function import function
from tests import ROOT
from tests.lipcore.export.test_function import train_estimator
from tests.lipcore.oracles import central_difference

EXAMPLE = runpy.run_path(str(ROOT / "docs/examples/planning.py"))


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return train_estimator("se")


def test_plan_approaches_the_goal(model: TorqueModel) -> None:
    answer, n = function(model), model.n_joints
    start, goal = torch.zeros(n, dtype=torch.float64), torch.full((n,), 0.5, dtype=torch.float64)
    plan = torch.zeros(20, n, dtype=torch.float64)

    def distance() -> float:
        positions = start + 0.05 * (0.05 * plan.cumsum(0)).cumsum(0)
        return float(((positions - goal) ** 2).sum())

    torch.manual_seed(0)
    first = distance()
    for _ in range(30):
        plan = EXAMPLE["plan_motion"](answer, start, start, goal, plan)
    assert distance() < 0.8 * first


def test_slope_equals_differences(model: TorqueModel) -> None:
    jax.config.update("jax_enable_x64", True)
    q, dq, ddq = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 4, model.n_joints))

    def moved(joint: int, step: float) -> np.ndarray:
        return (model.predict(q, dq, ddq + step * np.eye(model.n_joints)[joint]).mean ** 2).sum(axis=1)

    expected = np.stack(
        [central_difference(lambda step, joint=joint: moved(joint, step), 1e-3) for joint in range(model.n_joints)],
        axis=1,
    )
    slope = EXAMPLE["effort_slope"](function(model), *map(jax.numpy.asarray, (q, dq, ddq)))
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_policy_stays_near_the_model(model: TorqueModel) -> None:
    states = np.random.default_rng(1).uniform(-0.5, 0.5, (3, model.n_joints))
    expected = model.predict(*states[:, None])
    query = [torch.from_numpy(part) for part in states]
    for action, shift in ((0.0, 0.0), (1.0, 3.0), (-9.0, -3.0)):
        tau = EXAMPLE["residual_torque"](function(model), *query, torch.full((model.n_joints,), action))
        np.testing.assert_allclose(tau, (expected.mean + shift * expected.tau_std)[0], rtol=1e-5)
