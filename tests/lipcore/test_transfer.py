"""A second unit of an arm, learnt from few samples and from what another unit's model says of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.arms import another_unit
from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.data.metrics import evaluate
from lipcore.data.motion import Motion
from lipcore.estimators.base import BaseMismatchError, RobotKind, check_base
from lipcore.kernels.arm import ArmKernel
from lipcore.model.sibling import arm_as_expected, arm_of_sibling
from lipcore.robots.library import Robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from tests.choosing import slow
from tests.lipcore.arm_oracles import arm, followed, motions, pendulum_from_its_tip

OPTIONS = FitOptions(device="cpu", statistics="chosen", hyperparameter_samples=30, max_iterations=10)
FEW, LONG, NOISE = 25, 150, 1.0
"""Samples of the second unit, and six times as many; N·m."""
GEOMETRY, _, ROBOT = arm("RPR", 51)
SECOND = another_unit(ROBOT, 0.1, seed=0)


def recorded(robot: Robot, seed: int, size: int, noise: float = NOISE) -> Samples:
    """A unit in motion, each with friction of its own."""
    viscous = (2.0, 2.0, 0.3) if robot is ROBOT else (4.0, 1.0, 0.6)
    return simulate(robot, Simulation(size, speed=10, motion="full", noise=noise, viscous=viscous), seed)


@pytest.fixture(scope="module")
def base() -> TorqueModel:
    return followed(GEOMETRY, ROBOT, recorded(ROBOT, 1, 300), OPTIONS)


@pytest.fixture(scope="module")
def few() -> Samples:
    return recorded(SECOND, 3, FEW)


@pytest.fixture(scope="module")
def unseen() -> Samples:
    return recorded(SECOND, 4, 200)


def nmse(model: TorqueModel, samples: Samples) -> np.ndarray:
    return np.asarray(evaluate(samples.tau, *model.predict(samples.q, samples.dq, samples.ddq).interval).nmse)


@pytest.mark.parametrize("estimator", ["rigid-body", slow("rigid-body+lip-chain"), slow("auto")])
def test_few_samples_of_a_second_unit_suffice(estimator: str, base: TorqueModel, few: Samples, unseen: Samples) -> None:
    found = train(few, ROBOT.joint_types, estimator, OPTIONS, base=base)
    alone = followed(GEOMETRY, SECOND, few, OPTIONS)  # told the geometry, not the masses
    long = followed(GEOMETRY, SECOND, recorded(SECOND, 3, LONG), OPTIONS)
    without_noise = recorded(SECOND, 4, 200, noise=0.0)
    for other in (alone, base):
        assert nmse(found, without_noise).mean() < 0.5 * nmse(other, without_noise).mean()
    assert (nmse(found, unseen) < 2 * nmse(long, unseen)).all()
    answer = found.predict(unseen.q, unseen.dq, unseen.ddq)
    assert (evaluate(unseen.tau, *answer.interval).coverage > 0.85).all()
    assert found.fit["geometry"] == "calibrate"


def test_what_is_expected_is_the_other_unit(base: TorqueModel, unseen: Samples) -> None:
    """The torque that is expected is the other unit's, as Pinocchio has it, and spreads as far as units differ."""
    motion, kernel = unseen.motion(), ArmKernel(arm_of_sibling(base))
    true, second = (inverse_dynamics(each, unseen.q, unseen.dq, unseen.ddq) for each in (ROBOT, SECOND))
    mean = kernel.prior_weights()
    assert mean is not None
    off = kernel.torque(mean, motion) - true
    assert (np.sqrt(np.mean(off**2, axis=0)) < 0.05 * true.std(axis=0)).all()
    features, variance = kernel.features(motion), kernel.variances(kernel.initial(motion, unseen.tau))
    std = np.sqrt(np.square(features) @ variance)
    assert (np.sqrt(np.mean(std**2, axis=0)) < 0.5 * true.std(axis=0)).all()
    assert (np.mean(np.abs(second - true - off) < 2 * std, axis=0) > 0.9).all()


def test_joints_in_another_order_stay_what_they_are() -> None:
    base = pendulum_from_its_tip("calibrate", OPTIONS)
    expected, asked = arm_of_sibling(base), Motion.from_arrays(*motions(2, 3).transpose(1, 0, 2))
    term = base.estimator.terms["rigid_body"]
    torque = base.posterior.predict(asked, term).mean
    np.testing.assert_allclose(ArmKernel(expected).mean(asked), torque, atol=0.02 * np.abs(torque).max())


def test_a_transferred_version_keeps_what_was_expected(base: TorqueModel, few: Samples, tmp_path: Path) -> None:
    found = train(few, ROBOT.joint_types, "rigid-body", OPTIONS, base=base)
    save(found, tmp_path / "second")
    again = load(tmp_path / "second")
    np.testing.assert_allclose(
        again.predict(few.q, few.dq, few.ddq).tau, found.predict(few.q, few.dq, few.ddq).tau, rtol=0, atol=1e-6
    )
    kept, expected = arm_as_expected(again.arm), arm_of_sibling(base)
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(getattr(kept.geometry, name), getattr(expected.geometry, name), atol=1e-3)
    for name in ("centre", "rotor", "widths"):
        np.testing.assert_allclose(getattr(kept, name), getattr(expected, name), rtol=1e-9)


PANDA = RobotKind(("a", "b"), ("revolute", "prismatic"), "gravity_included")


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        ({"order": None}, "base", "'m:1', expected a version whose estimator has an arm, rigid-body or rigid-body"),
        (
            {"estimator": "lip"},
            "estimator",
            "'lip', expected one of auto, rigid-body, rigid-body+local, rigid-body+lip-chain with a",
        ),
        ({"data": replace(PANDA, joint_names=("a", "c"))}, "base", "joint_names of the data, a, c; it has a, b"),
        (
            {"data": replace(PANDA, joint_types=("revolute",) * 2)},
            "base",
            "joint_types of the data, revolute, revolute",
        ),
        ({"data": replace(PANDA, torque_convention="gravity_compensated")}, "base", "it has gravity_included"),
        ({"order": [1, 0], "estimator": "rigid-body+lip-chain"}, "estimator", "the base's joints go another way"),
        ({"robot": "panda"}, "robot", "'panda', expected none with a base"),
        ({"options": FitOptions(geometry="learn")}, "options.geometry", "'learn', expected auto, calibrate or fixed"),
        ({"options": FitOptions(prior="zero")}, "options.prior", "'zero', expected the default"),
    ],
)
def test_a_base_that_does_not_go_with_a_training(given: dict, field: str, message: str) -> None:
    usual = {"order": [0, 1], "data": PANDA, "estimator": "auto", "options": OPTIONS, "robot": None}
    check_base("m:1", PANDA, **usual)
    with pytest.raises(BaseMismatchError) as refused:
        check_base("m:1", PANDA, **{**usual, **given})
    assert refused.value.field == field
    assert f"{field} is " in str(refused.value)
    assert message in str(refused.value)


def test_training_refuses_a_base_of_another_robot(base: TorqueModel, few: Samples) -> None:
    other = replace(few, joint_names=("x", "y", "z"))
    with pytest.raises(BaseMismatchError, match="joint_names of the data, x, y, z; it has joint1, joint2, joint3"):
        train(other, ROBOT.joint_types, "rigid-body", OPTIONS, base=base)
