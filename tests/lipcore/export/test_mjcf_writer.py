"""Tests of arms as MJCF: MuJoCo computes the torque of the URDF, and errors are stated."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from lipcore import load
from lipcore.export.mjcf_writer import mjcf_text
from lipcore.export.origin import ModelOrigin, draw_states
from lipcore.export.sheet import Sheet
from lipcore.export.simulated_arm import SimulatedArm
from lipcore.export.urdf_writer import urdf_text
from lipcore.kernels.drive.terms import SIGN_WIDTH, drive_features
from lipcore.model.parameters import report
from lipcore.model.plausible import is_plausible, nearest_solid, pseudo_inertia
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, inverse_dynamics, sinusoids
from lipcore.robots.urdf import RigidBody
from tests.choosing import few
from tests.lipcore.arms import parameters, parameters_of, random_bodies, random_geometry
from tests.lipcore.export.models import MODELS, PANDA, train_arm, with_drive
from tests.lipcore.robots.test_urdf import joints, torque_of_urdf, training_range

mujoco = pytest.importorskip("mujoco", reason="needs the module mujoco, of the extra test")

from benchmarks.studies.mujoco_rollout import (  # noqa: E402 - imports mujoco
    follow,
    invert,
    motor_offset,
    open_arm,
    place_joints,
    relative_error,
)

LINE = ("viscous", "coulomb")
ORIGIN = ModelOrigin("an-arm", 3, 7, "0123")


def arm_of(model: TorqueModel) -> SimulatedArm:
    found = report(model.posterior, model.estimator, model.joint_names)
    return SimulatedArm.of_parameters(found, model.joint_names, model.training_range)


def arm_of_profile(name: str) -> SimulatedArm:
    robot = load_robot(name)
    body = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
    return SimulatedArm.of_parameters(parameters_of(body), robot.joint_names, training_range(robot.n_joints))


def arm_of_kinds(kinds: str, gravity: bool = True) -> SimulatedArm:
    n, names = len(kinds), [f"joint {letter}" for letter in "edcbagf"[: len(kinds)]]
    order = np.random.default_rng(n).permutation(n).tolist()
    given = parameters(random_geometry(kinds, 3, gravity), random_bodies(n, 3), names, order)
    return SimulatedArm.of_parameters(given, names, training_range(n))


ARMS = {
    "simulated panda, learnt": lambda: arm_of(load(PANDA)),
    "ur10": lambda: arm_of_profile("ur10"),
    "kinova": lambda: arm_of_profile("kinova"),
    "prismatic": lambda: arm_of_kinds("RPPRR"),
    "learnt geometry": lambda: arm_of_kinds("RRRRRRR"),
    "without gravity": lambda: arm_of_kinds("PRR", gravity=False),
    "two arms": lambda: arm_of_kinds("RPRrRP"),
}


@pytest.mark.parametrize("name", ARMS)
def test_mujoco_computes_the_torque_of_the_urdf(name: str) -> None:
    arm = ARMS[name]()
    names = list(arm.joints.names)
    motions = np.random.default_rng(1).normal(0, 1.5, (1000, 3, len(names)))
    expected = torque_of_urdf(urdf_text(arm), names, motions, bool(arm.geometry.gravity.any()))
    found = invert(mjcf_text(arm), tuple(names), motions) - arm.joints.offset
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


def test_file_has_origin_and_self_test() -> None:
    model = load(PANDA)
    sheet = Sheet.of(model, arm_of(model), ORIGIN, has_offset=True)
    arm = mujoco.MjModel.from_xml_string(mjcf_text(arm_of(model), "an-arm-v3", sheet))
    about = json.loads(bytes(arm.text_data).rstrip(b"\0"))
    expected = {"model": "an-arm", "version": 3, "revision": 7, "sha256": "0123", "joints": list(model.joint_names)}
    assert {name: about[name] for name in expected} == expected
    tests = {name: arm.numeric(f"selftest_{name}").data.reshape(100, -1) for name in sheet.self_test}
    motions = np.stack([tests[name] for name in ("q", "dq", "ddq")], axis=1)
    torque = invert(mjcf_text(arm_of(model)), model.joint_names, motions)
    np.testing.assert_allclose(torque, tests["tau"], atol=1e-6)
    served = model.predict(*motions.swapaxes(0, 1)).tau
    np.testing.assert_allclose(served, tests["model_tau"], atol=1e-6)
    # a URDF has the same facts as comments
    comments = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(urdf_text(arm_of(model), "an-arm-v3", sheet), parser=comments)
    texts = [each.text.strip() for each in root.iter(ElementTree.Comment)]
    assert [json.loads(text) for text in texts[-2:]] == [sheet.about, {"self_test": sheet.self_test}]


def test_joints_have_friction_rotor_range_and_motor() -> None:
    numbers = np.arange(3.0)
    given = joints(["a", "b", "<c>"], lower=-numbers, upper=numbers, viscous=0.1 - 0.2 * numbers, rotor=0.1 * numbers)
    given = replace(given, coulomb=0.3 * numbers, offset=numbers - 1.0)
    bodies = random_bodies(3, 3)
    text = mjcf_text(SimulatedArm(random_geometry("RPR", 3), bodies, given, np.arange(3)), 'my "arm"')
    arm = mujoco.MjModel.from_xml_string(text)
    assert [arm.joint(k).name for k in range(3)] == ["a", "b", "<c>"]
    np.testing.assert_allclose(arm.dof_armature, [0.0, 0.1, 0.2])
    np.testing.assert_allclose(arm.dof_damping.reshape(3, -1)[:, 0], [0.1, 0.0, 0.0])
    np.testing.assert_allclose(arm.dof_frictionloss, [0.0, 0.3, 0.6])
    np.testing.assert_allclose(arm.jnt_range[1:], [[-1, 1], [-2, 2]])
    assert arm.jnt_limited.tolist() == [0, 1, 1]  # the first joint has not moved
    np.testing.assert_allclose(arm.body_mass[2:], bodies[:, 0])
    np.testing.assert_allclose(arm.actuator_biasprm[:, 0], [1.0, 0.0, -1.0])
    np.testing.assert_allclose(arm.actuator_biasprm[:, 1:], 0.0)
    assert "learnt damping is -0.3" in text


def test_bodies_that_mujoco_rejects_are_moved_to_the_nearest() -> None:
    bodies, given = random_bodies(2, 3), joints(["a", "b"])
    flat = bodies.copy()
    flat[0, 4:] += np.array([0.5, 0, 0, 0, 0, 0])  # violates the triangle inequality
    flat[1] = [1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0]  # a point
    arm = SimulatedArm(random_geometry("RR", 3), flat, given, np.arange(2))
    text = mjcf_text(arm)
    assert text.count("to the nearest inertia that a body can have") == 2
    assert "to the nearest inertia" not in mjcf_text(replace(arm, bodies=bodies))
    mujoco.MjModel.from_xml_string(text)
    solid = nearest_solid(flat[0], 1e-12)
    assert is_plausible(solid)
    np.testing.assert_array_equal(solid[:4], flat[0, :4])

    def distance(other: np.ndarray) -> float:
        return float(np.linalg.norm(pseudo_inertia(other) - pseudo_inertia(flat[0])))

    rng = np.random.default_rng(0)
    for _ in range(300):  # no possible body of this mass and centre of mass is nearer
        other = solid + np.concatenate([np.zeros(4), rng.normal(0, 10 ** rng.uniform(-4, -1), 6)])
        assert distance(other) > distance(solid) or not is_plausible(other)


def drift(mjcf: str, names: tuple[str, ...], share: float) -> np.ndarray:
    """Return how far joints move within a second if friction has to hold a share of its maximum, (n,) rad."""
    arm = open_arm(mjcf, len(names))
    data, place = mujoco.MjData(arm), place_joints(arm, names)
    for _ in range(round(1.0 / arm.opt.timestep)):
        mujoco.mj_forward(arm, data)
        data.qfrc_applied[:] = data.qfrc_bias + share * arm.dof_frictionloss
        mujoco.mj_step(arm, data)
    return np.abs(data.qpos[place])


def test_friction_holds_joints_at_rest() -> None:
    arm = arm_of(load(PANDA))
    arm = replace(arm, joints=replace(arm.joints, coulomb=np.full(7, 0.3)))
    mjcf, names = mjcf_text(arm), arm.joints.names
    assert (drift(mjcf, names, 0.9) < 1e-3).all()
    assert (drift(mjcf, names, 1.5) > 1e-2).all()
    soft = mjcf.replace("solimpfriction", "solimplimit")  # MuJoCo's default
    assert drift(soft, names, 0.9).max() > 0.05


def test_control_is_torque_with_offset() -> None:
    """At rest without friction, the control that balances gravity is gravity plus the offset."""
    arm = replace(arm_of_kinds("RRR"), notes=())
    arm = replace(arm, joints=replace(arm.joints, coulomb=np.zeros(3), offset=np.array([0.5, -0.2, 1.0])))
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(arm))
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    data.ctrl[:] = data.qfrc_bias + arm.joints.offset
    mujoco.mj_forward(compiled, data)
    np.testing.assert_allclose(data.qacc, 0.0, atol=1e-9)
    np.testing.assert_allclose(motor_offset(compiled), arm.joints.offset)


DRIVES = {
    "slow joints": lambda: with_drive(train_arm("RRR", 50), "stribeck", "play"),
    "all kinds": MODELS["friction of all kinds"],
    "local": MODELS["local"],
}


@pytest.mark.parametrize("name", few(DRIVES, kept=lambda name: name == "slow joints"))
def test_stated_errors_are_those_of_the_file(name: str) -> None:
    model = DRIVES[name]()
    arm, found = arm_of(model), report(model.posterior, model.estimator, model.joint_names)["friction"]
    errors = Sheet.of(model, arm, ORIGIN).about["max_error"]

    def stated(term: str) -> np.ndarray:
        return np.array([errors[joint].get(term, 0.0) for joint in model.joint_names])

    np.testing.assert_allclose(stated("offset"), np.abs(found["offset"]["mean"]), rtol=0.01)
    motions = draw_states(model, 1000)
    q, dq, ddq = motions.swapaxes(0, 1)
    torque = torque_of_urdf(urdf_text(arm), list(model.joint_names), motions, gravity=True)
    torque += np.maximum(found["coulomb"]["mean"], 0.0) * (np.tanh(dq / SIGN_WIDTH) - np.sign(dq))
    off = np.abs(model.predict(q, dq, ddq).tau - torque).max(axis=0)
    np.testing.assert_allclose(stated("all"), off, rtol=0.01)
    with_offset = Sheet.of(model, arm, ORIGIN, has_offset=True).about["max_error"]
    assert not any("offset" in terms for terms in with_offset.values())
    off = np.abs(model.predict(q, dq, ddq).tau - torque - np.array(found["offset"]["mean"])).max(axis=0)
    np.testing.assert_allclose([with_offset[joint]["all"] for joint in model.joint_names], off, rtol=0.01)
    if name == "slow joints":
        curve = [
            np.array(found[term]["mean"]) * feature - np.maximum(found[term]["mean"], 0.0) * feature * (term in LINE)
            for term, feature in zip((*LINE, "stribeck"), drive_features(dq, ("stribeck",))[[0, 1, 3]], strict=True)
        ]
        np.testing.assert_allclose(stated("friction curve"), np.abs(sum(curve)).max(axis=0), rtol=0.01)
    else:
        assert (stated("play" if name == "all kinds" else "correction") > 0).any()


@pytest.mark.slow
def test_arm_that_follows_a_motion_needs_the_recorded_torque() -> None:
    model, robot = load(PANDA), load_robot("panda")
    simulation = Simulation(n_samples=1001, rate=100.0, speed=5.0)
    t = np.arange(1001) / 100.0
    q, dq, ddq = sinusoids(robot, simulation, t, np.random.default_rng(7))
    recorded = inverse_dynamics(robot, q, dq, ddq)
    found = follow(mjcf_text(arm_of(model)), model.joint_names, t, np.stack([q, dq, ddq], axis=1))
    error = relative_error(found[20:], recorded[20:])  # the controller settles within 0.2 s
    assert (error < 0.05).all()
