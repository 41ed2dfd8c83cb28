"""Tests of a second unit of an arm, learnt from few samples and another unit's model."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.arms import another_unit
from lipcore import FitOptions, Samples, TorqueModel, load, save, train
from lipcore.data.metrics import Metrics, evaluate
from lipcore.data.motion import Motion
from lipcore.estimators.base import BaseMismatchError, RobotKind, check_base
from lipcore.kernels.arm import ArmKernel
from lipcore.model.sibling import arm_as_expected, arm_of_sibling
from lipcore.robots.library import Robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from tests.choosing import slow
from tests.lipcore.arm_oracles import arm, random_motions, reversed_pendulum_model, train_from_geometry

OPTIONS = FitOptions(device="cpu", statistics="chosen", hyperparameter_samples=30, max_iterations=10)
FEW_ROWS, MANY_ROWS, NOISE = 25, 150, 1.0
"""Samples of the second unit, six times as many, and noise in N·m."""
GEOMETRY, _, ROBOT = arm("RPR", 51)
SECOND_UNIT = another_unit(ROBOT, 0.1, seed=0)


def simulate_unit(robot: Robot, seed: int, size: int, noise: float = NOISE) -> Samples:
    """Simulate a unit in motion, with its own friction."""
    viscous = (2.0, 2.0, 0.3) if robot is ROBOT else (4.0, 1.0, 0.6)
    return simulate(robot, Simulation(size, speed=10, motion="full", noise=noise, viscous=viscous), seed)


@pytest.fixture(scope="module")
def base() -> TorqueModel:
    return train_from_geometry(GEOMETRY, ROBOT, simulate_unit(ROBOT, 1, 300), OPTIONS)


def evaluate_on(model: TorqueModel, samples: Samples) -> Metrics:
    return evaluate(samples.tau, *model.predict(samples.q, samples.dq, samples.ddq).interval)


def nmse(model: TorqueModel, samples: Samples) -> np.ndarray:
    return np.asarray(evaluate_on(model, samples).nmse)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["rigid-body", slow("rigid-body+lip-chain"), slow("auto")])
def test_few_samples_of_a_second_unit_suffice(estimator: str, base: TorqueModel) -> None:
    few, many = (simulate_unit(SECOND_UNIT, 3, size) for size in (FEW_ROWS, MANY_ROWS))
    unseen, without_noise = (simulate_unit(SECOND_UNIT, 4, 200, noise) for noise in (NOISE, 0.0))
    found = train(few, ROBOT.joint_types, estimator, OPTIONS, base=base)
    # the geometry is known, the masses are not
    alone, long = (train_from_geometry(GEOMETRY, SECOND_UNIT, samples, OPTIONS) for samples in (few, many))
    for other in (alone, base):
        assert nmse(found, without_noise).mean() < 0.5 * nmse(other, without_noise).mean()
    assert (nmse(found, unseen) < 2 * nmse(long, unseen)).all()
    assert (evaluate_on(found, unseen).coverage > 0.85).all()
    assert found.fit["geometry"] == "calibrate"


def test_prior_is_the_other_unit(base: TorqueModel) -> None:
    """The expected torque is the other unit's by Pinocchio; its spread matches the difference of units."""
    unseen, kernel = simulate_unit(SECOND_UNIT, 4, 200), ArmKernel(arm_of_sibling(base))
    motion = unseen.motion()
    true, second = (inverse_dynamics(each, unseen.q, unseen.dq, unseen.ddq) for each in (ROBOT, SECOND_UNIT))
    off = kernel.torque(kernel.prior_weights(), motion) - true
    features, variance = kernel.features(motion), kernel.variances(kernel.initial(motion, unseen.tau))
    std = np.sqrt(np.square(features) @ variance)
    for size, share in ((off, 0.05), (std, 0.5)):
        assert (np.sqrt(np.mean(size**2, axis=0)) < share * true.std(axis=0)).all()
    assert (np.mean(np.abs(second - true - off) < 2 * std, axis=0) > 0.9).all()


def test_joint_order_is_kept() -> None:
    base = reversed_pendulum_model("calibrate", OPTIONS)
    expected, queries = arm_of_sibling(base), Motion.from_arrays(*random_motions(2, 3).transpose(1, 0, 2))
    torque = base.posterior.predict(queries, base.estimator.terms["rigid_body"]).mean
    np.testing.assert_allclose(ArmKernel(expected).mean(queries), torque, atol=0.02 * np.abs(torque).max())


def test_transferred_version_keeps_its_prior(base: TorqueModel, tmp_path: Path) -> None:
    few = simulate_unit(SECOND_UNIT, 3, FEW_ROWS)
    save(train(few, ROBOT.joint_types, "rigid-body", OPTIONS, base=base), tmp_path / "second")
    kept, expected = arm_as_expected(load(tmp_path / "second").arm), arm_of_sibling(base)
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(getattr(kept.geometry, name), getattr(expected.geometry, name), atol=1e-3)
    for name in ("centre", "rotor", "widths"):
        np.testing.assert_allclose(getattr(kept, name), getattr(expected, name), rtol=1e-9)


PANDA = RobotKind(("a", "b"), ("revolute", "prismatic"), "gravity_included")


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        ({"order": None}, "base", "'m:1', expected a version of estimator rigid-body or rigid-body"),
        (
            {"estimator": "lip"},
            "estimator",
            "'lip', expected one of auto, rigid-body, rigid-body+local, rigid-body+lip-chain if a base",
        ),
        ({"data": replace(PANDA, joint_names=("a", "c"))}, "base", "joint_names of the data, a, c; it has a, b"),
        (
            {"data": replace(PANDA, joint_types=("revolute",) * 2)},
            "base",
            "joint_types of the data, revolute, revolute",
        ),
        ({"data": replace(PANDA, torque_convention="gravity_compensated")}, "base", "it has gravity_included"),
        (
            {"order": [1, 0], "estimator": "rigid-body+lip-chain"},
            "estimator",
            "as the joints of the base have another order",
        ),
        (
            {"arms": 2, "estimator": "rigid-body+lip-chain"},
            "estimator",
            "expected auto or rigid-body or rigid-body+local, as the base has 2 arms and rigid-body+lip-chain needs",
        ),
        ({"robot": "panda"}, "robot", "'panda', expected no robot together with a base"),
        ({"options": FitOptions(geometry="learn")}, "options.geometry", "'learn', expected auto, calibrate or fixed"),
        ({"options": FitOptions(prior="zero")}, "options.prior", "'zero', expected the default"),
    ],
)
def test_mismatched_base_is_rejected(given: dict, field: str, message: str) -> None:
    usual = {"order": [0, 1], "data": PANDA, "estimator": "auto", "options": OPTIONS, "robot": None}
    check_base("m:1", PANDA, **usual)
    with pytest.raises(BaseMismatchError) as refused:
        check_base("m:1", PANDA, **{**usual, **given})
    assert refused.value.field == field
    assert f"{field} is " in str(refused.value)
    assert message in str(refused.value)


def test_training_rejects_a_base_of_another_robot(base: TorqueModel) -> None:
    other = replace(simulate_unit(SECOND_UNIT, 3, FEW_ROWS), joint_names=("x", "y", "z"))
    with pytest.raises(BaseMismatchError, match="joint_names of the data, x, y, z; it has joint1, joint2, joint3"):
        train(other, ROBOT.joint_types, "rigid-body", OPTIONS, base=base)
