"""Every estimator's online form keeps the contract of `online_checks`."""

from __future__ import annotations

import pytest

from lipcore import FitOptions, TorqueModel, train
from lipcore.fitting.estimators import ESTIMATORS
from lipcore.online.batch import Rows
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import ROBOT_ESTIMATORS
from tests.choosing import few
from tests.lipcore.online_checks import CHECKS, Check, as_rows

ROBOT = "double-pendulum"
OPTIONS = FitOptions(hyperparameter_samples=40, max_iterations=25, starts=1, device="cpu", compact_tolerance=0.1)


@pytest.fixture(scope="module", params=few(ESTIMATORS, {"lip-chain", "se", "rigid-body+lip-chain"}.__contains__))
def model(request: pytest.FixtureRequest) -> TorqueModel:
    samples = simulate(load_robot(ROBOT), Stream(n_samples=80, speed=10, noise=0.02, viscous=0.1), seed=1)
    robot = None
    if request.param in ROBOT_ESTIMATORS:
        robot = RigidBody.from_profile(ROBOT, samples.joint_names, ("revolute",) * 2)
    return train(samples, ("revolute",) * 2, request.param, OPTIONS, robot=robot)


@pytest.fixture(scope="module")
def rows() -> Rows:
    """Another motion of the same robot, which is a little more viscous than it was."""
    return as_rows(simulate(load_robot(ROBOT), Stream(n_samples=120, speed=10, noise=0.02, viscous=0.12), seed=2))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check, model: TorqueModel, rows: Rows) -> None:
    check(model, rows)
