"""How far a learnt arm has moved from where its torque is linear: rows of another arm, learnt online."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, Samples, TorqueModel, train
from lipcore.kernels.arm import ArmKernel
from lipcore.model.warnings import linearisation_error
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import Robot, random_arm
from lipcore.robots.simulation import Stream, inverse_dynamics, simulate

OPTIONS = FitOptions(search_seconds=10.0, statistics="chosen", device="cpu")
ROBOT = random_arm(4, joints=3)


def moving(robot: Robot, count: int, rate: float, seed: int) -> Samples:
    """Samples of an arm that moves over all of its range."""
    stream = Stream(count, rate, n_sinusoids=50, speed=10.0, motion="full", noise=0.05, viscous=0.3)
    return simulate(robot, stream, seed)


def turned(angle: float) -> Robot:
    """ROBOT with the axis of its second joint turned, rad."""
    model = ROBOT.model.copy()
    place = model.jointPlacements[2].copy()
    place.rotation = place.rotation @ pin.exp3(np.array([angle, 0.0, 0.0]))
    model.jointPlacements[2] = place
    return replace(ROBOT, model=model)


def after(model: TorqueModel, robot: Robot) -> float:
    """Largest error of linearisation after a thousand rows of an arm."""
    samples = moving(robot, 1000, 100.0, seed=2)
    rows = Rows(samples.t, samples.q, samples.dq, samples.ddq, samples.tau, np.zeros(len(samples), np.uint8))
    return largest(OnlineModel.start(model).learn(rows).model())


def largest(model: TorqueModel) -> float:
    found = linearisation_error(model)
    assert found is not None
    assert found.shape == (3,)
    return float(found.max())


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return train(moving(ROBOT, 400, 10.0, seed=1), ROBOT.joint_types, "rigid-body", OPTIONS)


def test_an_arm_as_trained_is_where_it_is_linear(model: TorqueModel) -> None:
    assert largest(model) < 1e-3


def test_the_error_rises_where_an_axis_has_turned_and_not_where_it_has_hardly(model: TorqueModel) -> None:
    same, little, far = (after(model, turned(angle)) for angle in (0.0, 0.02, 0.3))
    assert same < little < 0.1
    assert far > 1.0


def test_a_geometry_that_is_not_learnt_has_no_error(model: TorqueModel) -> None:
    assert linearisation_error(train(moving(ROBOT, 30, 10.0, seed=1), ROBOT.joint_types, "se")) is None


def test_the_torque_of_an_arms_weights_is_that_of_the_arm(model: TorqueModel) -> None:
    """Against Pinocchio, of the arm's own bodies in a geometry that is a step away."""
    term, rng = model.estimator.terms["rigid_body"], np.random.default_rng(0)
    assert isinstance(term, ArmKernel)
    weights = np.zeros(term.size)
    bodies = [inertia.toDynamicParameters() for inertia in tuple(ROBOT.model.inertias)[1:]]
    weights[:30] = np.array(bodies).reshape(-1)
    weights[30:33] = rotor = np.array([0.1, 0.2, 0.3])
    weights[term.steps] = 0.1 * rng.standard_normal(term.arm.steps)
    geometry, robot = term.geometry(weights), ROBOT.model.copy()
    for joint in range(3):
        robot.jointPlacements[joint + 1] = pin.SE3(geometry.rotation[joint], geometry.translation[joint])
    samples = moving(ROBOT, 20, 10.0, seed=3)
    expected = inverse_dynamics(replace(ROBOT, model=robot), samples.q, samples.dq, samples.ddq)
    found = term.torque(weights, samples.motion())
    np.testing.assert_allclose(found, expected + rotor * samples.ddq, atol=1e-9 * np.abs(expected).max())
