"""What a model says of what its recording leaves open, and how far an arm has moved from where its torque is linear."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, load, save, train
from lipcore.fitting.estimators import make_estimator
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.model.parameters import report
from lipcore.model.warnings import linearisation_error, warnings
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import Robot
from lipcore.robots.simulation import Stream, inverse_dynamics, simulate
from tests.lipcore.arm_oracles import arm, followed
from tests.lipcore.online_checks import as_rows

GEOMETRY, BODIES, ROBOT = arm("RRR", 31)
SHARE, MORE = 0.27, 1.5
"""Probability of the other arm, and what its second joint has more of viscous friction, N·m·s/rad."""


def moving(robot: Robot, count: int, rate: float, seed: int) -> Samples:
    """Samples of an arm that moves over all of its range."""
    stream = Stream(count, rate, n_sinusoids=50, speed=10.0, motion="full", noise=0.05, viscous=0.3)
    return simulate(robot, stream, seed)


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return followed(GEOMETRY, ROBOT, moving(ROBOT, 400, 10.0, seed=1), FitOptions(search_seconds=10.0, device="cpu"))


@pytest.fixture(scope="module")
def other() -> TorqueModel:
    """A model without an arm, of joints that move together."""
    samples = moving(ROBOT, 60, 10.0, seed=1)
    together = replace(samples, dq=samples.dq[:, :1] * np.array([1.0, -0.5, 2.0]))
    return train(together, ROBOT.joint_types, "se", FitOptions(hyperparameter_samples=20, max_iterations=3, starts=1))


@pytest.fixture(scope="module")
def parameters(model: TorqueModel) -> dict[str, Any]:
    return report(model.posterior, model.estimator, model.joint_names)


def test_a_good_recording_calls_for_nothing(model: TorqueModel, parameters: dict[str, Any]) -> None:
    assert warnings(model, parameters) == []


def test_joints_that_moved_together_are_named_by_any_estimator(other: TorqueModel) -> None:
    [text] = warnings(other, {})
    assert text.startswith("Its joints moved together, like 1.0 independent ones of 3")
    assert warnings(replace(other, fit={**other.fit, "motion_dimensions": 3.0}), {}) == []


def test_another_arm_comes_with_the_motion_that_tells_them_apart(model: TorqueModel) -> None:
    assert model.arm is not None
    friction = np.zeros((3, 3))
    first = Alternative(model.arm.geometry, model.arm.parameters, np.zeros(3), friction, 1 - SHARE)
    second = replace(first, friction=friction + np.outer([0, MORE, 0], [1, 0, 0]), probability=SHARE)
    both = replace(model.arm, alternatives=(first, second))
    [text] = warnings(replace(model, estimator=make_estimator("rigid-body", model.joint_types, True, both)), {})
    assert text.startswith(
        "Two arms explain the recording about as well (73% and 27%); their difference is in tau_std."
    )
    range_of = model.training_range["dq"]
    assert f"joint2 is faster than {max(-range_of['min'][1], range_of['max'][1]):.2g} rad/s" in text
    speeds = 2 * model.posterior.basis.inducing.dq[:, 1].numpy()
    differ = MORE * np.sqrt(SHARE * (1 - SHARE) * np.mean(speeds**2))
    assert f"they differ by {differ:.2g} N·m in joint2" in text


def test_how_the_fit_ended(model: TorqueModel) -> None:
    late, coarse = warnings(replace(model, fit={**model.fit, "search_ended": "time", "search_explained": False}), {})
    assert "time limit, 10 s" in late
    assert coarse.endswith("Compare with rigid-body+lip-chain.")


def test_numbers_of_the_geometry_that_are_open(model: TorqueModel, parameters: dict[str, Any]) -> None:
    joints = [{**each, "undetermined": []} for each in parameters["geometry"]["joints"]]
    joints[1]["undetermined"], joints[2]["undetermined"] = ["turn 1", "shift 1"], ["shift 2"]
    geometry = {"geometry": {"joints": joints}}
    [text] = warnings(model, geometry)
    assert "3 numbers of the geometry" in text
    assert "(joint2: turn 1, shift 1; joint3: shift 2)" in text
    together = replace(model, fit={**model.fit, "motion_dimensions": 1.2})
    assert "like 1.2 independent ones of 3" in warnings(together, geometry)[1]
    joints[2]["undetermined"] = []
    assert warnings(together, geometry) == []  # no torque depends on two


def test_a_manifest_holds_them(model: TorqueModel, tmp_path: Path) -> None:
    late = replace(model, fit={**model.fit, "search_ended": "time"})
    manifest = save(late, tmp_path / "late")
    assert manifest["warnings"] == warnings(late, manifest["parameters"])
    assert len(manifest["warnings"]) == 1
    for wrong in ("a text", [""], ["x"] * 21, [1]):
        (tmp_path / "late/manifest.json").write_text(json.dumps(manifest | {"warnings": wrong}))
        with pytest.raises(ModelFormatError, match="warnings"):
            load(tmp_path / "late")


def after(model: TorqueModel, angle: float) -> float:
    """Largest error of linearisation after a thousand rows of the arm with its second axis turned, rad."""
    turned = ROBOT.model.copy()
    place = turned.jointPlacements[2].copy()
    place.rotation = place.rotation @ pin.exp3(np.array([angle, 0.0, 0.0]))
    turned.jointPlacements[2] = place
    rows = as_rows(moving(replace(ROBOT, model=turned), 1000, 100.0, seed=2))
    error = linearisation_error(OnlineModel.start(model).learn(rows).model())
    assert error is not None
    assert error.shape == (3,)
    return float(error.max())


def test_the_error_of_linearisation_rises_where_an_axis_has_turned(model: TorqueModel, other: TorqueModel) -> None:
    trained = linearisation_error(model)
    assert trained is not None
    assert trained.max() < 1e-3
    same, little, far = (after(model, angle) for angle in (0.0, 0.02, 0.3))
    assert same < little < 0.1
    assert far > 1.0
    assert linearisation_error(other) is None


def test_the_torque_of_an_arms_weights_is_that_of_the_arm(model: TorqueModel) -> None:
    """Against Pinocchio, of the arm's own bodies in a geometry that is a step away."""
    term, rng = model.estimator.terms["rigid_body"], np.random.default_rng(0)
    assert isinstance(term, ArmKernel)
    weights = np.zeros(term.size)
    weights[:30] = BODIES.reshape(-1)
    weights[30:33] = rotor = np.array([0.1, 0.2, 0.3])
    weights[term.steps] = 0.1 * rng.standard_normal(term.arm.steps)
    geometry, moved = term.geometry(weights), ROBOT.model.copy()
    for joint in range(3):
        moved.jointPlacements[joint + 1] = pin.SE3(geometry.rotation[joint], geometry.translation[joint])
    samples = moving(ROBOT, 20, 10.0, seed=3)
    expected = inverse_dynamics(replace(ROBOT, model=moved), samples.q, samples.dq, samples.ddq)
    torque = term.torque(weights, samples.motion())
    np.testing.assert_allclose(torque, expected + rotor * samples.ddq, atol=1e-9 * np.abs(expected).max())
