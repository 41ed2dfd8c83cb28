"""Simulated robots: joints, motion and torque against Pinocchio asked directly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from lipcore.robots.library import ROBOTS, Robot, UnknownRobotError, load_robot
from lipcore.robots.simulation import Payload, Stream, simulate

JOINTS = {
    "panda": (7, "panda_joint1", "panda_joint7"),
    "ur3": (6, "shoulder_pan_joint", "wrist_3_joint"),
    "ur5": (6, "shoulder_pan_joint", "wrist_3_joint"),
    "ur10": (6, "shoulder_pan_joint", "wrist_3_joint"),
    "xarm7": (7, "joint1", "joint7"),
    "kinova": (6, "j2s6s200_joint_1", "j2s6s200_joint_6"),
    "z1": (6, "joint1", "joint6"),
    "so100": (6, "shoulder_pan", "gripper"),
    "so101": (6, "shoulder_pan", "gripper"),
    "baxter-left": (7, "left_s0", "left_w2"),
    "baxter-right": (7, "right_s0", "right_w2"),
    "pr2-left": (7, "l_shoulder_pan_joint", "l_wrist_roll_joint"),
    "pr2-right": (7, "r_shoulder_pan_joint", "r_wrist_roll_joint"),
    "talos-left": (6, "arm_left_2_joint", "arm_left_7_joint"),
    "tiago": (8, "torso_lift_joint", "arm_7_joint"),
    "tiago-pro-left": (7, "arm_left_1_joint", "arm_left_7_joint"),
    "tiago-pro-right": (7, "arm_right_1_joint", "arm_right_7_joint"),
    "double-pendulum": (2, "joint1", "joint2"),
    "asr-twodof": (2, "J1", "J2"),
    "finger-edu": (3, "finger_base_to_upper_joint", "finger_middle_to_lower_joint"),
}


@pytest.fixture(scope="module")
def panda() -> Robot:
    return load_robot("panda")


def rnea(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Torque at each instant, the configuration integrated from neutral so that unbounded joints work too."""
    data, neutral = robot.model.createData(), pin.neutral(robot.model)
    rows = zip(q, dq, ddq, strict=True)
    return np.array([pin.rnea(robot.model, data, pin.integrate(robot.model, neutral, x), v, a) for x, v, a in rows])


def test_every_robot_is_documented_here() -> None:
    assert JOINTS.keys() == ROBOTS.keys()


@pytest.mark.parametrize("name", JOINTS)
def test_every_robot_moves_its_joints_with_the_torque_of_pinocchio(name: str) -> None:
    robot = load_robot(name)
    count, first, last = JOINTS[name]
    assert (robot.n_joints, robot.joint_names[0], robot.joint_names[-1]) == (count, first, last)
    samples = simulate(robot, Stream(n_samples=20, motion="full", speed=10, noise=0.0), seed=1)
    assert samples.tau.shape == (20, count)
    assert samples.joint_names == robot.joint_names
    expected = rnea(robot, samples.q, samples.dq, samples.ddq)
    assert np.allclose(samples.tau, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert np.abs(samples.tau).max() > 1e-4


def test_only_the_lift_of_tiago_is_prismatic() -> None:
    kinds = {name: load_robot(name).joint_types for name in ROBOTS}
    assert kinds.pop("tiago") == ("prismatic", *["revolute"] * 7)
    assert {kind for types in kinds.values() for kind in types} == {"revolute"}


def test_unknown_robot_lists_the_known_ones() -> None:
    with pytest.raises(UnknownRobotError, match="robot is 'r2d2', expected one of panda, ur3") as caught:
        load_robot("r2d2")
    assert all(name in str(caught.value) for name in ROBOTS)


def test_equal_seeds_give_equal_samples_and_others_do_not(panda: Robot) -> None:
    one, same, other = (simulate(panda, Stream(n_samples=30), seed) for seed in (3, 3, 4))
    for name in ("t", "q", "dq", "ddq", "tau"):
        assert np.array_equal(getattr(one, name), getattr(same, name))
    for name in ("q", "dq", "ddq", "tau"):
        assert not np.allclose(getattr(one, name), getattr(other, name))


def test_velocity_and_acceleration_are_the_derivatives_of_position(panda: Robot) -> None:
    rate = 1000.0
    fine = simulate(panda, Stream(n_samples=3000, rate=rate, speed=10), seed=0)
    assert np.allclose(np.diff(fine.t), 1 / rate)
    for signal, derivative in ((fine.q, fine.dq), (fine.dq, fine.ddq)):
        error = np.gradient(signal, 1 / rate, axis=0)[1:-1] - derivative[1:-1]
        assert np.abs(error).max() < 1e-4 * np.abs(derivative).max()


@pytest.mark.parametrize("name", ["panda", "ur5", "tiago"])
def test_middle_motion_spans_half_a_radian_about_the_middle_unless_speed_limits_it(name: str) -> None:
    robot = load_robot(name)
    samples = simulate(robot, Stream(motion="middle", speed=10), seed=2)
    reach = np.minimum(0.5, (robot.upper - robot.lower) / 2)
    check_span(robot, samples, reach)


@pytest.mark.parametrize("name", ["panda", "kinova", "tiago"])
def test_full_motion_spans_the_joint_range_unless_speed_limits_it(name: str) -> None:
    robot = load_robot(name)
    samples = simulate(robot, Stream(motion="full", speed=10), seed=2)
    assert (samples.q > robot.lower).all()
    assert (samples.q < robot.upper).all()
    check_span(robot, samples, 0.95 * (robot.upper - robot.lower) / 2)


def check_span(robot: Robot, samples, reach: np.ndarray) -> None:
    """Within reach of the middle and within speed, and at the limit of one of the two."""
    away = np.abs(samples.q - (robot.lower + robot.upper) / 2).max(0)
    speed = np.abs(samples.dq).max(0)
    assert (away <= reach * (1 + 1e-9)).all()
    assert (speed <= robot.speed * (1 + 1e-9)).all()
    assert (np.isclose(away, reach) | np.isclose(speed, robot.speed)).all()


def test_friction_and_noise_are_added_as_stated(panda: Robot) -> None:
    plain = Stream(n_samples=400, speed=10, noise=0.0)
    viscous, coulomb = np.linspace(0.1, 0.7, 7), 0.3
    clean = simulate(panda, plain, seed=5)
    rubbing = simulate(panda, replace(plain, viscous=tuple(viscous), coulomb=coulomb), seed=5)
    assert np.array_equal(rubbing.q, clean.q)
    expected = clean.tau + viscous * clean.dq + coulomb * np.sign(clean.dq)
    assert np.allclose(rubbing.tau, expected, rtol=0, atol=1e-12)

    noisy = simulate(panda, replace(plain, noise=0.2), seed=5)
    assert np.array_equal(noisy.q, clean.q)
    assert np.std(noisy.tau - clean.tau) == pytest.approx(0.2, rel=0.05)


def test_payload_changes_torque_only_from_when_it_is_attached(panda: Robot) -> None:
    free = Stream(n_samples=50, speed=10, noise=0.05)
    payload = Payload(mass=2.0, at=2.0, offset=(0.02, 0.0, 0.15))
    without, loaded = simulate(panda, free, seed=6), simulate(panda, replace(free, payload=payload), seed=6)
    before = without.t < 2.0
    assert before.sum() == 20
    assert np.array_equal(loaded.q, without.q)
    assert np.array_equal(loaded.tau[before], without.tau[before])
    assert (np.abs(loaded.tau - without.tau)[~before].max(1) > 0.1).all()


def test_payload_is_the_weight_it_says(panda: Robot) -> None:
    """The extra torque does the work of lifting the mass: Jᵀ m (a − g) of its point."""
    payload = Payload(mass=1.5, offset=(0.0, 0.03, 0.1))
    stream = Stream(n_samples=10, speed=10, noise=0.0)
    free, loaded = simulate(panda, stream, seed=7), simulate(panda, replace(stream, payload=payload), seed=7)
    model = panda.model.copy()
    frame = model.addFrame(
        pin.Frame("load", 7, 0, pin.SE3(np.eye(3), np.array(payload.offset)), pin.FrameType.OP_FRAME)
    )
    data = model.createData()
    for k in range(10):
        pin.computeAllTerms(model, data, free.q[k], free.dq[k])
        jacobian = pin.computeFrameJacobian(model, data, free.q[k], frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        pin.forwardKinematics(model, data, free.q[k], free.dq[k], free.ddq[k])
        acceleration = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
        force = payload.mass * (acceleration - model.gravity.linear)
        assert np.allclose(loaded.tau[k] - free.tau[k], jacobian.T @ force, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"n_samples": 1}, "n_samples"),
        ({"n_sinusoids": 0}, "n_sinusoids"),
        ({"rate": 0.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"speed": -1.0}, "speed"),
        ({"speed": float("inf")}, "speed"),
        ({"noise": -0.1}, "noise"),
        ({"noise": float("nan")}, "noise"),
        ({"motion": "wild"}, "motion"),
        ({"viscous": -1.0}, "viscous"),
        ({"viscous": (1.0, 2.0)}, "viscous"),
        ({"coulomb": float("nan")}, "coulomb"),
        ({"payload": Payload(mass=-1.0)}, "payload mass"),
        ({"payload": Payload(mass=float("nan"))}, "payload mass"),
        ({"payload": Payload(mass=float("inf"))}, "payload mass"),
    ],
    ids=str,
)
def test_stream_that_cannot_be_simulated_names_the_field(panda: Robot, changes: dict, field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field} "):
        simulate(panda, replace(Stream(n_samples=5), **changes), seed=0)
