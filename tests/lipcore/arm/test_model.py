"""Tests of models with a learnt arm: storage, reports, online learning and alternative arms."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, ModelFormatError, Samples, TorqueModel, load, save
from lipcore.data.motion import Array, Motion
from lipcore.estimators.catalogue import make_estimator
from lipcore.files import persistence
from lipcore.files.entries import Parameters
from lipcore.files.manifest import read_manifest_bytes
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import Alternative
from lipcore.kernels.drive.terms import drive_features
from lipcore.model.parameters import inertial_parameters, report
from lipcore.online.learner import OnlineModel
from lipcore.posterior.compression import build_linear
from tests import ROOT
from tests.lipcore.arm_oracles import (
    arm,
    as_robot,
    as_rows,
    nmse_per_joint,
    random_motions,
    record_motion,
    reversed_pendulum_model,
    train_from_geometry,
)
from tests.lipcore.arms import parameters, random_bodies, random_geometry
from tests.lipcore.files.test_persistence import edit_tensor

OPTIONS = FitOptions(device="cpu", statistics="chosen")
GEOMETRY, _, ROBOT = arm("RPR", 51)
TYPES = ROBOT.joint_types


@pytest.fixture(scope="module")
def samples() -> Samples:
    return record_motion(ROBOT, 1, 100)


@pytest.fixture(scope="module")
def learnt_model(samples: Samples) -> TorqueModel:
    return train_from_geometry(GEOMETRY, ROBOT, samples, OPTIONS)


def with_alternatives(model: TorqueModel, samples: Samples, count: int = 1) -> TorqueModel:
    """Return the model with `count` other arms as alternatives."""
    found = model.arm
    assert found is not None
    rng, n = np.random.default_rng(0), found.n_joints
    shares = np.array([0.6, *np.linspace(0.3, 0.1, count)])
    shares /= shares.sum()
    # the frames of another arm may have other axes
    turned = replace(found.geometry, axis=found.geometry.axis[:, [1, 2, 0]])
    others = [
        Alternative(
            turned.moved(0.1 * place * rng.standard_normal(found.geometry.size)) if place else found.geometry,
            found.parameters + 0.05 * place * random_bodies(n, place),
            0.01 * rng.random(n),
            0.1 * rng.random((n, len(found.friction.terms))),
            float(share),
        )
        for place, share in enumerate(shares)
    ]
    chosen = make_estimator("rigid-body", model.joint_types, arm=replace(found, alternatives=tuple(others)))
    posterior = model.posterior
    once = np.broadcast_to(posterior.noise_variance, samples.tau.shape)
    made = build_linear(chosen.kernel, posterior.params, samples, once, 0.01, 1.0, posterior.misfit)
    return replace(model, estimator=chosen, posterior=made.posterior)


@pytest.mark.parametrize("kind", ["learn", "calibrate", "fixed", "alternatives"])
def test_saved_arm_loads_unchanged(kind: str, learnt_model: TorqueModel, samples: Samples, tmp_path: Path) -> None:
    if kind in ("calibrate", "fixed"):
        model = reversed_pendulum_model(kind, OPTIONS)
    else:
        model = learnt_model if kind == "learn" else with_alternatives(learnt_model, samples, 2)
    manifest = save(model, tmp_path / "model")
    again = load(tmp_path / "model")
    queries = random_motions(model.n_joints, 3).transpose(1, 0, 2)
    before, after = (each.predict(*queries, covariance=True) for each in (model, again))
    for name in ("tau", "tau_std", "covariance", "noise_std"):
        one, other = getattr(before, name), getattr(after, name)
        np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-9 * np.abs(one).max())
    assert model.arm is not None
    assert again.arm is not None
    assert again.arm.mode == manifest["parameters"]["geometry"]["mode"] == model.arm.mode
    assert again.arm.order.tolist() == manifest["parameters"]["geometry"]["order"]
    assert len(again.arm.alternatives) == (3 if kind == "alternatives" else 0)
    assert (again.robot is None) == (kind in ("learn", "alternatives"))
    if kind in ("calibrate", "fixed"):
        assert again.arm.order.tolist() == [1, 0]


Change = Callable[[Any], Array | None]
INVALID_TENSORS: dict[str, tuple[str, Change, str]] = {
    "no rotation": ("rotation", lambda values: 2 * values, "not a rotation"),
    "no axis": ("axis", np.zeros_like, "not of length one"),
    "missing": ("unit", lambda values: None, "'arm/unit' is missing"),
    "order": ("order", np.zeros_like, "expected each joint once"),
    "widths": ("widths", np.zeros_like, "positive numbers"),
    "parameters": ("parameters", lambda values: values[:2], "parameters has shape"),
    "rotor": ("rotor", lambda values: np.ones(2), "rotor has shape"),
    "steps": ("expected", lambda values: values[:1], "expected has shape"),
    "not finite": ("translation", lambda values: values * np.nan, "finite"),
    "coefficients": (
        "other/linear",
        lambda values: values[:, :, :2],
        r"'arm/other/linear' has shape \(3, 3, 2\), expected \(3, 3, 4\)",
    ),
    "no probability": ("other/probability", np.zeros_like, "outside 0 to 1"),
    "improbable": ("other/probability", lambda values: 0 * values + 0.9, "positive definite|cholesky"),
    "none": ("other/probability", lambda values: np.zeros(0), "has shape"),
    "unknown": ("shadow", lambda values: np.zeros(1), "does not know"),
}
"""By id: a tensor of the arm, its change, and the message."""


@pytest.mark.parametrize("name", INVALID_TENSORS)
def test_invalid_arm_tensors_are_rejected(
    name: str, learnt_model: TorqueModel, samples: Samples, tmp_path: Path
) -> None:
    tensor, change, message = INVALID_TENSORS[name]
    save(with_alternatives(learnt_model, samples, 2), tmp_path / "model")
    edit_tensor(tmp_path / "model", f"arm/{tensor}", change)
    with pytest.raises(ModelFormatError, match=message):
        load(tmp_path / "model")


def test_unknown_geometry_mode_is_rejected(learnt_model: TorqueModel) -> None:
    manifest, files = persistence.encode(learnt_model)
    manifest["fit"]["geometry"] = "guess"
    with pytest.raises(ModelFormatError, match=r"fit\.geometry is 'guess', expected one of learn, calibrate, fixed"):
        persistence.decode({**files, "manifest.json": persistence.manifest_bytes(manifest)})


@pytest.mark.parametrize("count", [1, 2, 3])
def test_alternative_arms_have_the_moments_of_their_mixture(
    learnt_model: TorqueModel, samples: Samples, count: int
) -> None:
    found = with_alternatives(learnt_model, samples, count).arm
    assert found is not None
    queries = random_motions(3, 4)
    query = Motion.from_arrays(*queries.transpose(1, 0, 2))
    terms = drive_features(query.dq).transpose(1, 2, 0)
    torques = []
    for each in found.alternatives:
        model_of, flat = as_robot(each.geometry, random_bodies(3, 0)).model, each.parameters.reshape(-1)
        data = model_of.createData()  # learnt bodies may be unphysical, hence Pinocchio's regressor
        bodies = np.array([pin.computeJointTorqueRegressor(model_of, data, *motion) @ flat for motion in queries])
        torques.append(bodies + each.rotor * queries[:, 2] + (terms * each.friction).sum(-1))
    more, shares = np.array(torques) - torques[0], np.array([each.probability for each in found.alternatives])
    mean = np.einsum("k,kni->ni", shares, more)
    spread = np.einsum("k,kni,knj->nij", shares, more - mean, more - mean)
    alone, mixed = ArmKernel(replace(found, alternatives=())), ArmKernel(found)
    scale = {"rigid_body.log_scale": np.zeros(4)}
    np.testing.assert_allclose((mixed.mean(query) - alone.mean(query)), mean, rtol=1e-8, atol=1e-9)
    added = mixed.variance(scale, query) - alone.variance(scale, query)
    prior = float(np.abs(alone.variance(scale, query)).max())
    np.testing.assert_allclose(added, spread, rtol=1e-8, atol=1e-12 * prior)


def record_heavier_arm(seed: int, size: int) -> Samples:
    """Record another arm of the same kind with a mass at its tip."""
    robot = arm("RPR", 51)[2]
    robot.model.inertias[3] += pin.Inertia(0.5, robot.model.inertias[3].lever, np.zeros((3, 3)))
    return record_motion(robot, seed, size)


def test_arm_learns_online(learnt_model: TorqueModel) -> None:
    more, queries = record_heavier_arm(5, 300), record_heavier_arm(6, 60)
    start, rows = OnlineModel.start(learnt_model, forgetting_s=None), as_rows(more, began=0.0)
    before = nmse_per_joint(start.model(), queries)
    changed = nmse_per_joint(start.change(-1.0).learn(rows).model(), queries)
    assert (changed < 0.01 * before).all(), (before, changed)


def test_report_of_a_learnt_arm(learnt_model: TorqueModel) -> None:
    reported = report(learnt_model.posterior, learnt_model.estimator, learnt_model.joint_names)
    assert reported["geometry"]["mode"] == "learn"
    joints = reported["geometry"]["joints"]
    assert [joint["type"] for joint in joints] == list(TYPES)
    assert [len(joint["turn_std"]) for joint in joints] == [2, 2, 2]
    assert [len(joint["shift_std"]) for joint in joints] == [0, 0, 2]
    # torque determines the direction of the last axis, but not a rotation of the whole arm about gravity
    assert all(0 < std < 0.1 for std in joints[2]["turn_std"])
    assert joints[0]["undetermined"]
    for joint in joints:
        spread = dict(zip(("turn 1", "turn 2"), joint["turn_std"], strict=True))  # prior: 1 rad
        spread |= dict(zip(("shift 1", "shift 2"), 2 * np.array(joint["shift_std"]), strict=False))  # prior: 0.5 m
        assert joint["undetermined"] == [name for name, share in spread.items() if share > 0.5]
    assert len(reported["rotor"]["mean"]) == len(reported["rotor"]["std"]) == 3
    # torque does not determine the mass of the body that turns about the first axis
    assert "mass" in reported["inertia"]["bodies"][0]["undetermined"]
    inertia = inertial_parameters(learnt_model.posterior, learnt_model.estimator)
    assert inertia.mean.shape == inertia.std.shape == (3, 10)


ORDER = [2, 0, 1]
SHIPPED = ROOT / "models" / "panda-sim"


def manifest(reported: Any) -> bytes:
    """Return the manifest of the shipped model, cut to three joints, with these parameters."""
    shipped = json.loads((SHIPPED / "manifest.json").read_text())
    for name in ("joint_names", "joint_types", "noise_std"):
        shipped[name] = shipped[name][:3]
    for ends in shipped["training_range"].values():
        ends["min"], ends["max"] = ends["min"][:3], ends["max"][:3]
    return persistence.manifest_bytes({**shipped, "parameters": reported})


@pytest.fixture
def reported() -> Any:
    names = json.loads(manifest({}))["joint_names"]
    return parameters(random_geometry("RPR", 1), random_bodies(3, 1), names, ORDER)


def test_report_is_read_back(reported: Any) -> None:
    entry = msgspec.convert(read_manifest_bytes(manifest(reported))["parameters"], Parameters)
    assert entry.geometry.order == ORDER
    np.testing.assert_array_equal(entry.geometry.geometry().constants, random_geometry("RPR", 1).constants)
    np.testing.assert_array_equal(entry.inertia.plausible()[ORDER], random_bodies(3, 1))


def test_arm_must_be_reported_completely(reported: Any) -> None:
    read_manifest_bytes(manifest({"friction": reported["friction"]}))
    with pytest.raises(ModelFormatError, match="inertia, rotor and geometry are not all present"):
        read_manifest_bytes(manifest({name: reported[name] for name in ("friction", "inertia")}))


MIRRORED_ROW = random_geometry("RPR", 1).rotation[0, 0, ::-1].tolist()
MALFORMED_REPORTS: dict[str, tuple[str, Any]] = {
    r"parameters.geometry.mode is 'guess', expected one of learn": ("geometry.mode", "guess"),
    r"parameters.geometry: Object missing required field `order`": ("geometry.order", ...),
    r"parameters.geometry: order is .*, expected each of the joints 0 to 2": ("geometry.order", [0, 0, 1]),
    r"parameters.geometry.gravity\[2\] is": ("geometry.gravity", [0, 0, "down"]),
    r"parameters.geometry.joints is a list of 2 entries, expected 3": ("geometry.joints.2", ...),
    r"parameters.geometry.joints\[1\].type": ("geometry.joints.1.type", "ball"),
    r"parameters.geometry.joints\[0\]: turn_std has 1 value": ("geometry.joints.0.turn_std", [0.1]),
    r"parameters.geometry.joints\[0\].undetermined": ("geometry.joints.0.undetermined", ["x"]),
    r"parameters.geometry.joints\[2\]: Object contains unknown field `mesh`": ("geometry.joints.2.mesh", "file"),
    r"parameters.geometry: rotation contains a matrix": ("geometry.joints.0.rotation.0", MIRRORED_ROW),
    r"parameters.rotor.std is": ("rotor.std", [0.1]),
    r"parameters.inertia.bodies\[1\].mean.first_moment\[0\] is": ("inertia.bodies.1.mean.first_moment", [None, 0, 0]),
    r"parameters.inertia.bodies\[0\].undetermined is": ("inertia.bodies.0.undetermined", "mass"),
    r"parameters: Object contains unknown field `colour`": ("colour", "red"),
}
"""By message: the place of an entry and its wrong value, or `...` if it is removed."""


@pytest.mark.parametrize("expected", MALFORMED_REPORTS)
def test_malformed_report_is_rejected(reported: Any, expected: str) -> None:
    path, value = MALFORMED_REPORTS[expected]
    *parents, last = (int(part) if part.isdigit() else part for part in path.split("."))
    entry = reduce(getitem, parents, reported)
    if value is ...:
        del entry[last]
    else:
        entry[last] = value
    with pytest.raises(ModelFormatError, match=expected.replace("'", "['\"]")):
        read_manifest_bytes(manifest(reported))
