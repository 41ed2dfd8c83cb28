"""Tests of a model's warnings, its linearisation error, and friction at low speed."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from benchmarks.arms import random_arm
from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, load, save, train
from lipcore.arm import drive
from lipcore.data.motion import Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.files.arm import arm_tensors, read_arm
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.geometry import Geometry
from lipcore.model.parameters import friction_coefficients, report
from lipcore.model.texts import describe_failed_fit
from lipcore.model.warnings import REFIT_ERROR, linearisation_error, warnings
from lipcore.online.learner import OnlineModel
from lipcore.robots.library import Robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, simulate
from tests.lipcore.arm_oracles import arm, as_rows, nmse_per_joint, train_from_geometry

GEOMETRY, BODIES, ROBOT = arm("RRR", 31)
PROBABILITY, EXTRA_VISCOUS = 0.27, 1.5
"""Probability of the second arm, and extra viscous friction of its second joint, N·m·s/rad."""


def simulate_full_motion(robot: Robot, count: int, rate: float, seed: int) -> Samples:
    """Simulate an arm that moves over all of its range."""
    stream = Simulation(count, rate, n_sinusoids=50, speed=10.0, motion="full", noise=0.05, viscous=0.3)
    return simulate(robot, stream, seed)


@pytest.fixture(scope="module")
def model() -> TorqueModel:
    return train_from_geometry(
        GEOMETRY, ROBOT, simulate_full_motion(ROBOT, 400, 10.0, seed=1), FitOptions(search_seconds=10.0, device="cpu")
    )


@pytest.fixture(scope="module")
def black_box() -> TorqueModel:
    """Return a model without an arm, of joints that move together."""
    samples = simulate_full_motion(ROBOT, 60, 10.0, seed=1)
    together = replace(samples, dq=samples.dq[:, :1] * np.array([1.0, -0.5, 2.0]))
    return train(together, ROBOT.joint_types, "se", FitOptions(hyperparameter_samples=20, max_iterations=3, starts=1))


@pytest.fixture(scope="module")
def parameters(model: TorqueModel) -> dict[str, Any]:
    return report(model.posterior, model.estimator, model.joint_names)


def test_good_recording_has_no_warnings(model: TorqueModel, parameters: dict[str, Any]) -> None:
    assert warnings(model, parameters) == []


def test_joints_that_moved_together_are_named(black_box: TorqueModel) -> None:
    black_box = replace(black_box, training_torque=None)
    [text] = warnings(black_box, {})
    assert text.startswith("The joints moved together: 3 joints moved like 1.0 independent ones.")
    assert warnings(replace(black_box, fit={**black_box.fit, "motion_dimensions": 3.0}), {}) == []


def test_second_arm_is_reported_with_a_distinguishing_motion(model: TorqueModel) -> None:
    assert model.arm is not None
    friction = np.zeros((3, 3))
    first = Alternative(model.arm.geometry, model.arm.parameters, np.zeros(3), friction, 1 - PROBABILITY)
    second = replace(first, friction=friction + np.outer([0, EXTRA_VISCOUS, 0], [1, 0, 0]), probability=PROBABILITY)
    both = replace(model.arm, alternatives=(first, second))
    [text] = warnings(replace(model, estimator=make_estimator("rigid-body", model.joint_types, True, both)), {})
    assert text.startswith(
        "Two arms explain the recording about equally well (probabilities 73% and 27%); tau_std includes their"
    )
    range_of = model.training_range["dq"]
    assert f"joint2 moves faster than {max(-range_of['min'][1], range_of['max'][1]):.2g} rad/s" in text
    speeds = 2 * model.posterior.basis.inducing.dq[:, 1]
    differ = EXTRA_VISCOUS * np.sqrt(PROBABILITY * (1 - PROBABILITY) * np.mean(speeds**2))
    assert f"they differ by {differ:.2g} N·m in joint2" in text


def test_end_of_the_fit_is_reported(model: TorqueModel) -> None:
    late, coarse = warnings(replace(model, fit={**model.fit, "search_ended": "time", "search_explained": False}), {})
    assert "after 10 s of processor time" in late
    assert coarse.endswith("Compare with rigid-body+lip-chain.")
    failed = warnings(replace(model, fit={**model.fit, REFIT_ERROR: "ValueError: no"}), {})
    assert failed == [describe_failed_fit("ValueError: no")]
    assert failed[0].startswith("The final fit, on all rows, failed (ValueError: no).")


def test_unidentifiable_geometry_parameters_are_counted(model: TorqueModel, parameters: dict[str, Any]) -> None:
    joints = [{**each, "undetermined": []} for each in parameters["geometry"]["joints"]]
    joints[1]["undetermined"], joints[2]["undetermined"] = ["turn 1", "shift 1"], ["shift 2"]
    geometry = {"geometry": {"joints": joints}}
    [text] = warnings(model, geometry)
    assert text.startswith("3 geometry parameters are not identifiable from this recording. They ")
    assert "(joint2: turn 1, shift 1; joint3: shift 2)" in text
    together = replace(model, fit={**model.fit, "motion_dimensions": 1.2})
    assert "3 joints moved like 1.2 independent ones" in warnings(together, geometry)[1]
    joints[2]["undetermined"] = []
    assert warnings(together, geometry) == []  # no torque depends on two of the parameters


def test_manifest_contains_warnings(model: TorqueModel, tmp_path: Path) -> None:
    late = replace(model, fit={**model.fit, "search_ended": "time"})
    manifest = save(late, tmp_path / "late")
    assert manifest["warnings"] == warnings(late, manifest["parameters"])
    assert len(manifest["warnings"]) == 1
    for wrong in ("a text", [""], ["x"] * 21, [1]):
        (tmp_path / "late/manifest.json").write_text(json.dumps(manifest | {"warnings": wrong}))
        with pytest.raises(ModelFormatError, match="warnings"):
            load(tmp_path / "late")


def error_after_turn(model: TorqueModel, angle: float) -> float:
    """Return the largest linearisation error after 1000 rows of an arm with a turned second axis, rad."""
    turned = ROBOT.model.copy()
    place = turned.jointPlacements[2].copy()
    place.rotation = place.rotation @ pin.exp3(np.array([angle, 0.0, 0.0]))
    turned.jointPlacements[2] = place
    rows = as_rows(simulate_full_motion(replace(ROBOT, model=turned), 1000, 100.0, seed=2))
    error = linearisation_error(OnlineModel.start(model).learn(rows).model())
    assert error is not None
    assert error.shape == (3,)
    return float(error.max())


def test_linearisation_error_grows_with_a_turned_axis(model: TorqueModel, black_box: TorqueModel) -> None:
    trained = linearisation_error(model)
    assert trained is not None
    assert trained.max() < 1e-3
    same, little, far = (error_after_turn(model, angle) for angle in (0.0, 0.02, 0.3))
    assert same < little < 0.1
    assert far > 1.0
    assert linearisation_error(black_box) is None


def test_torque_of_weights_matches_pinocchio(model: TorqueModel) -> None:
    """The geometry is one step away from the arm's."""
    term, rng = model.estimator.terms["rigid_body"], np.random.default_rng(0)
    assert isinstance(term, ArmKernel)
    weights = np.zeros(term.size)
    weights[:30] = BODIES.reshape(-1)
    weights[30:33] = rotor = np.array([0.1, 0.2, 0.3])
    weights[term.steps] = 0.1 * rng.standard_normal(term.arm.steps)
    geometry, moved = term.geometry(weights), ROBOT.model.copy()
    for joint in range(3):
        moved.jointPlacements[joint + 1] = pin.SE3(geometry.rotation[joint], geometry.translation[joint])
    samples = simulate_full_motion(ROBOT, 20, 10.0, seed=3)
    expected = inverse_dynamics(replace(ROBOT, model=moved), samples.q, samples.dq, samples.ddq)
    torque = term.torque(weights, samples.motion())
    np.testing.assert_allclose(torque, expected + rotor * samples.ddq, atol=1e-9 * np.abs(expected).max())


SLOW_ROBOT = random_arm(1, joints=3)
SLOW_PLACEMENTS = SLOW_ROBOT.model.jointPlacements[1:]
SLOW_GEOMETRY = Geometry(
    SLOW_ROBOT.joint_types,
    np.array([place.rotation for place in SLOW_PLACEMENTS]),
    np.array([place.translation for place in SLOW_PLACEMENTS]),
    np.tile([0.0, 0.0, 1.0], (3, 1)),
    SLOW_ROBOT.model.gravity.linear.copy(),
)


def simulate_slow_motion(seed: int, stribeck: float) -> Samples:
    """Simulate slow motion with Coulomb friction of 0.4 N·m and Stribeck friction."""
    stream = Simulation(300, n_sinusoids=30, speed=5.0, noise=0.05, viscous=0.3)
    samples = simulate(SLOW_ROBOT, stream, seed)
    fading = 0.4 + stribeck * np.exp(-((samples.dq / 0.1) ** 2))
    return replace(samples, tau=samples.tau + fading * np.tanh(samples.dq / 0.02))


def train_slow_arm(stribeck: float) -> TorqueModel:
    return train_from_geometry(SLOW_GEOMETRY, SLOW_ROBOT, simulate_slow_motion(1, stribeck), FitOptions(device="cpu"))


@pytest.fixture(scope="module")
def stribeck_model() -> TorqueModel:
    return train_slow_arm(0.5)


@pytest.mark.slow
def test_stribeck_friction_is_learnt_if_present(stribeck_model: TorqueModel, monkeypatch: pytest.MonkeyPatch) -> None:
    assert stribeck_model.fit["drive"] == "stribeck"
    assert float(stribeck_model.fit["drive_nats"]) > 10
    friction = friction_coefficients(stribeck_model.posterior, stribeck_model.estimator)
    assert friction.stribeck is not None
    assert (np.abs(friction.stribeck - 0.5) < 3 * friction.stribeck_std).all()
    assert (friction.stribeck_std < 0.1).all()
    monkeypatch.setattr(drive, "OPTIONS", replace(drive.OPTIONS, kinds=()))
    without, unseen = train_slow_arm(0.5), simulate_slow_motion(2, 0.5)
    assert not without.fit["drive"]
    assert nmse_per_joint(stribeck_model, unseen).mean() < 0.8 * nmse_per_joint(without, unseen).mean()


@pytest.mark.slow
def test_stribeck_friction_is_not_learnt_if_absent() -> None:
    smooth = train_slow_arm(0.0)
    assert not smooth.fit["drive"]
    assert smooth.fit["drive_nats"] == 0
    assert friction_coefficients(smooth.posterior, smooth.estimator).stribeck is None


def test_alternative_arms_have_stribeck_friction(stribeck_model: TorqueModel) -> None:
    known = stribeck_model.arm
    assert known is not None
    rng, given = np.random.default_rng(0), (known.geometry, known.parameters)
    each = [Alternative(*given, rng.random(3), rng.random((3, 4)), share) for share in (0.7, 0.3)]
    both = replace(known, alternatives=tuple(each))
    again = read_arm(arm_tensors(both), SLOW_ROBOT.joint_types, both.mode)
    assert again.drive == ("stribeck",)
    np.testing.assert_array_equal(again.alternatives[1].friction, each[1].friction)
    kernel = ArmKernel(again)
    dq = np.array([[0.05, -0.05, 0.5]])
    fading = np.tanh(dq / 0.02) * np.exp(-((dq / 0.1) ** 2))
    still = Motion(dq * 0, dq, dq * 0)
    less = replace(each[1], friction=each[1].friction * [1, 1, 1, 0])
    other = ArmKernel(replace(both, alternatives=(each[0], less)))
    differ = kernel.mean(still) - other.mean(still)
    np.testing.assert_allclose(differ, 0.3 * fading * each[1].friction[:, 3], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["stribeck", "drive"])
@pytest.mark.parametrize("values", [[0.5], [], [float("nan")], [1.0, 0.0]])
def test_invalid_drive_is_rejected(stribeck_model: TorqueModel, name: str, values: list[float]) -> None:
    known = stribeck_model.arm
    assert known is not None
    tensors = arm_tensors(known) | {f"arm/{name}": np.array(values)}
    with pytest.raises(ValueError, match=f"'arm/{name}' is"):
        read_arm(tensors, SLOW_ROBOT.joint_types, known.mode)


@pytest.mark.parametrize(("flag", "kinds"), [(0.0, ()), (1.0, ("stribeck",))])
def test_arm_of_earlier_release_keeps_its_friction(
    stribeck_model: TorqueModel, flag: float, kinds: tuple[str, ...]
) -> None:
    known = stribeck_model.arm
    assert known is not None
    tensors = {name: value for name, value in arm_tensors(known).items() if name != "arm/drive"}
    tensors["arm/stribeck"] = np.array([flag])
    assert read_arm(tensors, SLOW_ROBOT.joint_types, known.mode).drive == kinds


def test_stribeck_friction_is_learnt_online(stribeck_model: TorqueModel) -> None:
    online = OnlineModel.start(stribeck_model, forgetting_s=None).change(-1.0)
    learnt = online.learn(as_rows(simulate_slow_motion(5, 1.0), began=0.0)).model()
    unseen = simulate_slow_motion(6, 1.0)
    assert (nmse_per_joint(learnt, unseen) < nmse_per_joint(stribeck_model, unseen)).all()
    friction = friction_coefficients(learnt.posterior, learnt.estimator)
    assert friction.stribeck is not None
    assert (friction.stribeck > 0.7).all()
