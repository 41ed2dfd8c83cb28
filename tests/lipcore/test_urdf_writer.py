"""A learnt arm as a URDF: Pinocchio reads it and gives the arm's torque."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from lipcore import FitOptions, train
from lipcore.files.persistence import encode
from lipcore.files.urdf_writer import ArmJoints, rpy, urdf_of_parameters, urdf_text
from lipcore.kernels.compiled.arm import arm_torques
from lipcore.kernels.geometry import Geometry, rotation_of
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Stream, simulate
from lipcore.robots.urdf import RigidBody, describe
from tests.lipcore.arms import parameters, parameters_of, random_bodies, random_geometry


def training_range(n: int) -> dict[str, dict[str, list[float]]]:
    low = [-1.0 - 0.1 * joint for joint in range(n)]
    return {name: {"min": low, "max": [2.0] * n} for name in ("q", "dq", "ddq")}


def joints(names: list[str], **changed: object) -> ArmJoints:
    n = len(names)
    zero = np.zeros(n)
    given = {"lower": zero - 1, "upper": zero + 1, "velocity": zero + 2, "viscous": zero, "coulomb": zero}
    return ArmJoints(tuple(names), **{**given, "offset": zero, "rotor": zero, **changed})


def drives(urdf: str, names: list[str]) -> dict[str, np.ndarray]:
    """What the text says of friction and rotors, in the order of the names."""
    root = ElementTree.fromstring(urdf)
    dynamics = [root.find(f"joint[@name='{name}']/dynamics").attrib for name in names]
    rotor = {
        each.find("joint").get("name"): float(each.find("actuator/{http://drake.mit.edu}rotor_inertia").get("value"))
        for each in root.findall("transmission")
    }
    terms = {key: np.array([float(each[key]) for each in dynamics]) for key in ("damping", "friction")}
    return {**terms, "rotor": np.array([rotor[name] for name in names])}


def torque_of_urdf(urdf: str, names: list[str], motions: np.ndarray, gravity: bool) -> np.ndarray:
    """Recursive Newton–Euler of Pinocchio, with the rotors and the friction that the text names; data's order."""
    model = pin.buildModelFromXML(urdf)
    if not gravity:
        model.gravity.setZero()
    data, place = model.createData(), [model.names[1:].tolist().index(name) for name in names]
    out, drive = np.empty((len(motions), len(names))), drives(urdf, names)
    for row, (q, dq, ddq) in enumerate(motions):
        chain = np.empty((3, len(names)))
        chain[:, place] = q, dq, ddq
        out[row] = pin.rnea(model, data, *chain)[place] + drive["rotor"] * ddq
        out[row] += drive["damping"] * dq + drive["friction"] * np.sign(dq)
    return out


@pytest.mark.parametrize("kinds", ["R", "PR", "RRP", "RPPR", "RRRRRR", "RPRRRRR"])
@pytest.mark.parametrize("gravity", [True, False])
def test_its_torque_is_the_arms(kinds: str, gravity: bool) -> None:
    n, seed = len(kinds), len(kinds) + gravity
    rng = np.random.default_rng(seed)
    geometry, bodies = random_geometry(kinds, seed, gravity), random_bodies(n, seed)
    order, names = rng.permutation(n), [f"joint {letter}" for letter in "edcbagf"[:n]]
    report = parameters(geometry, bodies, names, order.tolist())
    urdf = urdf_of_parameters(report, names, training_range(n))
    motions = rng.normal(0, 1.5, (20, 3, n))
    expected = np.empty((20, n))
    arm_torques(geometry.constants, geometry.gravity, bodies, order, motions, expected)
    expected += np.array(report["rotor"]["mean"]) * motions[:, 2]
    for term, feature in (("viscous", motions[:, 1]), ("coulomb", np.sign(motions[:, 1]))):
        expected += np.array(report["friction"][term]["mean"]) * feature
    np.testing.assert_allclose(torque_of_urdf(urdf, names, motions, gravity), expected, rtol=1e-9, atol=1e-9)


def test_that_of_a_trained_arm_has_the_torque_that_it_has_learnt() -> None:
    samples = simulate(load_robot("double-pendulum"), Stream(n_samples=300, speed=5.0), seed=1)
    options = FitOptions(hyperparameter_samples=80, posterior_samples=200, max_iterations=20, device="cpu")
    model = train(samples, ["revolute"] * 2, "rigid-body", options)
    manifest, _ = encode(model)
    names, report = list(model.joint_names), manifest["parameters"]
    urdf = urdf_of_parameters(report, names, manifest["training_range"])
    motions = np.stack([samples.q, samples.dq, samples.ddq], axis=1)[::3]
    given = torque_of_urdf(urdf, names, motions, gravity=True) + report["friction"]["offset"]["mean"]
    learnt = model.predict(*motions.transpose(1, 0, 2)).tau
    # what the text leaves out: rotors and friction below zero, geometry beyond the first order
    np.testing.assert_array_less(np.sqrt(np.mean((given - learnt) ** 2, axis=0)), 0.05 * learnt.std(axis=0))


def test_a_panda_comes_back() -> None:
    robot = load_robot("panda")
    names = tuple(reversed(robot.joint_names))
    panda = RigidBody.from_profile("panda", names, robot.joint_types)
    urdf = urdf_of_parameters(parameters_of(panda), names, training_range(7), "panda")
    back = RigidBody.from_urdf(urdf, names, robot.joint_types)
    assert back.order == panda.order
    np.testing.assert_allclose(back.parameters(), panda.parameters(), atol=1e-12)
    one, other = Geometry.from_robot(back), Geometry.from_robot(panda)
    np.testing.assert_allclose(one.constants, other.constants, atol=1e-12)
    assert 'name="world"' not in urdf  # its base stands upright


def test_names_and_numbers_are_kept_as_they_are() -> None:
    names = ['a<b>&"c"', "base", "base_link", "world_to_base", "größe -- 1"]
    geometry = random_geometry("RPRRR", 3)
    words = tuple(("mass", "shift 1") if k == 2 else () for k in range(5))
    numbers = np.arange(5.0)
    given = joints(names, lower=-numbers, upper=numbers, offset=numbers, undetermined=words)
    urdf = urdf_text(geometry, random_bodies(5, 3), given, 'my "arm"')
    model = pin.buildModelFromXML(urdf)
    assert model.names[1:].tolist() == names
    assert model.name == 'my "arm"'
    np.testing.assert_array_equal(model.lowerPositionLimit, -numbers)
    np.testing.assert_array_equal(model.upperPositionLimit, numbers)
    np.testing.assert_array_equal(model.velocityLimit, 2.0)
    assert describe(urdf).joint_names == tuple(names)
    assert "torque does not tell: mass, shift 1" in urdf
    assert "offset torque 4.0" in urdf


def test_the_limit_of_torque_does_not_bind() -> None:
    geometry, bodies = random_geometry("RRPR", 7), random_bodies(4, 7)
    model = pin.buildModelFromXML(urdf_text(geometry, bodies, joints(list("abcd"))))
    motions = np.random.default_rng(0).uniform(-1, 1, (200, 3, 4)) * np.array([1.0, 2.0, 5.0])[:, None]
    torques = np.empty((200, 4))
    arm_torques(geometry.constants, geometry.gravity, bodies, np.arange(4), motions, torques)
    assert (np.abs(torques).max(axis=0) < model.effortLimit).all()


def test_negative_friction_is_written_as_none_with_a_comment() -> None:
    urdf = urdf_text(random_geometry("R", 1), random_bodies(1, 1), joints(["a"], viscous=np.array([-0.5])))
    assert 'damping="0.0"' in urdf
    assert "learnt damping is -0.5" in urdf


@pytest.mark.parametrize("pitch", [0.0, 0.3, np.pi / 2, -np.pi / 2])
def test_angles_give_the_rotation(pitch: float) -> None:
    roll, yaw = 0.7, -2.1
    turns = [rotation_of(angle * axis) for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)]
    rotation = turns[0] @ turns[1] @ turns[2]
    np.testing.assert_allclose(pin.rpy.rpyToMatrix(rpy(rotation)), rotation, atol=1e-15)


def test_what_has_no_urdf_is_refused() -> None:
    report, names = parameters(random_geometry("RR", 1), random_bodies(2, 1), ["a", "b"], [0, 1]), ["a", "b"]
    with pytest.raises(ValueError, match="no rigid bodies"):
        urdf_of_parameters({"friction": report["friction"]}, names, training_range(2))
    with pytest.raises(ValueError, match="where its joints lie"):
        urdf_of_parameters({key: report[key] for key in ("friction", "inertia")}, names, training_range(2))
    report["inertia"]["bodies"][1]["plausible"]["mass"] = -1.0
    with pytest.raises(ValueError, match="joint 'b' moves is -1 kg"):
        urdf_of_parameters(report, names, training_range(2))
    with pytest.raises(ValueError, match=r"names\[1\] is 'a'"):
        joints(["a", "a"])
    with pytest.raises(ValueError, match="lower is"):
        joints(["a"], lower=np.array([3.0]))
    with pytest.raises(ValueError, match="rotor is"):
        joints(["a"], rotor=np.array([np.nan]))
    with pytest.raises(ValueError, match="bodies has shape"):
        urdf_text(random_geometry("RR", 1), random_bodies(3, 1), joints(["a", "b"]))


def test_gravity_of_another_strength_has_a_comment() -> None:
    geometry = random_geometry("R", 1)
    urdf = urdf_text(replace(geometry, gravity=geometry.gravity / 6), random_bodies(1, 1), joints(["a"]))
    assert "set it in the simulator" in urdf
