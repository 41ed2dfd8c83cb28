"""Where joint axes lie, and the compiled dynamics: against Pinocchio and the derivatives of the arm's energies."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from torch.func import jacrev

from lipcore.data.motion import Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.fast.arm import arm_energies, arm_masses, arm_shapes, arm_torques
from lipcore.kernels.geometry import Geometry, rotation_of, rotation_to_axis, rotation_vector_of, skew
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from tests.lipcore.arm_oracles import arm, energies, lagrangian_torque, motions, tensor
from tests.lipcore.arms import random_geometry
from tests.lipcore.test_urdf import joint, link
from tests.lipcore.test_urdf import robot as robot_of

KINDS = ("R", "RPR", "PRR", "RRRR")


def placements(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.configuration(q))
    places = list(data.oMi)[1:]
    return np.array([each.rotation for each in places]), np.array([each.translation for each in places])


def regressor(geometry: Geometry, asked: np.ndarray) -> np.ndarray:
    """∂τ/∂π at motions, all rows below each other: (N n, 10 n)."""
    n = geometry.n_joints
    out = np.empty((len(asked), 10 * n, n))
    arm_masses(geometry.constants, geometry.gravity, np.arange(n), asked, out)
    return out.transpose(0, 2, 1).reshape(-1, 10 * n)


def reaches(features: np.ndarray, torque: np.ndarray) -> float:
    """What the best weights leave of a torque, as a share of it."""
    weights = np.linalg.lstsq(features, torque, rcond=None)[0]
    return float(np.linalg.norm(torque - features @ weights) / np.linalg.norm(torque))


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("kinds", KINDS)
def test_a_step_leads_where_it_was_measured(kinds: str, gravity: bool) -> None:
    geometry = random_geometry(kinds, 1, gravity)
    step = np.random.default_rng(2).uniform(-0.3, 0.3, geometry.size)
    other = geometry.moved(step)
    np.testing.assert_allclose(geometry.towards(other), step, atol=1e-12)
    np.testing.assert_allclose(geometry.towards(geometry), 0 * step, atol=1e-15)
    # the way back, as the other one sees it, to first order
    for size in (1e-2, 1e-3):
        back = geometry.moved(size * step).towards(geometry)
        np.testing.assert_allclose(back, -size * step, rtol=0, atol=2 * size**2)


def test_how_many_numbers_torque_tells() -> None:
    for kinds, gravity, expected in (
        ("R", True, (2,)),
        ("R", False, (0,)),
        ("P", True, (2,)),
        ("RPR", True, (2, 2, 4)),
        ("PRR", False, (0, 4, 4)),
    ):
        geometry = random_geometry(kinds, 3, gravity)
        assert geometry.screws == expected
        assert geometry.size == sum(expected) == len(geometry.turns) == len(geometry.shifts())
        assert geometry.turns.sum() == sum(min(count, 2) for count in expected)


@pytest.mark.parametrize("kinds", KINDS)
def test_the_canonical_arm_has_the_same_torques(kinds: str) -> None:
    """Bodies are told relative to their frames, so the same weights do not: but some weights do."""
    geometry, _, robot = arm(kinds, 5)
    asked, canonical = motions(len(kinds), 6, size=30), geometry.canonical()
    torque = inverse_dynamics(robot, *asked.transpose(1, 0, 2)).reshape(-1)
    assert reaches(regressor(geometry, asked), torque) < 1e-10
    assert reaches(regressor(canonical, asked), torque) < 1e-10
    again = canonical.canonical()
    np.testing.assert_allclose(again.translation, canonical.translation, atol=1e-12)
    assert not canonical.translation[0].any()
    for j, kind in enumerate(canonical.joint_types):
        along = canonical.translation[j] @ canonical.rotation[j] @ canonical.axis[j]
        assert along == pytest.approx(0.0, abs=1e-12)
        assert kind == "revolute" or not canonical.translation[j].any()
    if len(kinds) > 1:  # elsewhere an axis does make a difference
        assert reaches(regressor(geometry.moved(np.full(geometry.size, 0.1)), asked), torque) > 1e-3


@pytest.mark.parametrize("name", ["double-pendulum", "panda", "kinova", "tiago"])
def test_placements_of_a_robot_are_those_of_pinocchio(name: str) -> None:
    robot = load_robot(name)
    body = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
    geometry = Geometry.from_robot(body)
    for q in motions(robot.n_joints, 11)[:, 0]:
        for found, expected in zip(geometry.placements(q), placements(robot, q), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_array_equal(geometry.gravity, robot.model.gravity.linear)
    assert not Geometry.from_robot(body, gravity=False).gravity.any()


def test_axes_that_are_aligned_with_nothing_are_read_from_pinocchio() -> None:
    types = ("revolute", "prismatic", "revolute")
    parts = [joint(name, *name, kind=kind) for name, kind in zip(("ab", "bc", "cd"), types, strict=True)]
    tilted = [
        part.replace('"0 1 0"', axis).replace('xyz="0 0 0.3"', 'xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"')
        for part, axis in zip(parts, ('"1 2 -2"', '"2 -1 2"', '"-3 0 4"'), strict=True)
    ]
    body = RigidBody.from_urdf(robot_of(*map(link, "abcd"), *tilted), ("ab", "bc", "cd"), types)
    geometry = Geometry.from_robot(body)
    np.testing.assert_allclose(geometry.axis, np.array([[1, 2, -2], [2, -1, 2], [-1.8, 0, 2.4]]) / 3, atol=1e-12)
    robot = Robot("odd", body.model, body.joint_names, types, *np.zeros((3, 3)))
    for q in motions(3, 12)[:, 0]:
        for found, expected in zip(geometry.placements(q), placements(robot, q), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_rotations() -> None:
    for turn in (np.array([0.3, -0.2, 0.9]), np.array([0.0, 0.0, 3.0]), np.zeros(3)):
        np.testing.assert_allclose(rotation_of(turn), pin.exp3(turn), atol=1e-12)
        np.testing.assert_allclose(rotation_vector_of(rotation_of(turn)), turn, atol=1e-9)
        np.testing.assert_allclose(skew(turn) @ [1.0, 2.0, 3.0], np.cross(turn, [1.0, 2.0, 3.0]), atol=1e-12)
    for axis in (*np.eye(3), np.array([2.0, -1.0, 2.0]) / 3):
        turned = rotation_to_axis(axis)
        np.testing.assert_allclose(turned[:, 2], axis)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)


def test_what_is_no_geometry_is_refused() -> None:
    good = random_geometry("RR", 13)
    parts = {name: getattr(good, name) for name in ("rotation", "translation", "axis", "gravity")}
    for name, value, message in (
        ("rotation", 2 * good.rotation, "no rotation"),
        ("rotation", good.rotation[:1], "rotation has shape"),
        ("translation", np.full((2, 3), np.nan), "translation has shape"),
        ("axis", 3 * good.axis, "not of length one"),
        ("gravity", np.zeros(2), "gravity has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            Geometry(good.joint_types, **{**parts, name: value})


ROBOTS = ("double-pendulum", "panda", "kinova", "tiago")
CHAINS = ("RPR", "PRR", "RRP", "RRRR", "P", "R")
EXACT = 1e-10
"""Share of the largest number that rounding may make of a difference."""


def agree(found: np.ndarray, expected: np.ndarray, share: float = EXACT) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * np.abs(expected).max())


def torque_of(geometry: Geometry, bodies: np.ndarray, order: np.ndarray, asked: np.ndarray) -> np.ndarray:
    out = np.empty((len(asked), geometry.n_joints))
    arm_torques(geometry.constants, geometry.gravity, np.ascontiguousarray(bodies), order, asked, out)
    return out


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_torque_of_a_robot_is_that_of_pinocchio(name: str, gravity: bool) -> None:
    robot = load_robot(name)
    n = robot.n_joints
    asked = motions(n, 1)
    expected = inverse_dynamics(robot, *asked.transpose(1, 0, 2))
    if not gravity:
        data = robot.model.createData()
        still = [pin.computeGeneralizedGravity(robot.model, data, robot.configuration(q)).copy() for q in asked[:, 0]]
        expected = expected - np.array(still)
    for seed in (None, 0, 1):
        columns = np.arange(n) if seed is None else np.random.default_rng(seed).permutation(n)
        names, types = (tuple(parts[i] for i in columns) for parts in (robot.joint_names, robot.joint_types))
        body = RigidBody.from_profile(name, names, types)
        made = arm_of_robot(body, gravity)
        mine = np.ascontiguousarray(asked[:, :, columns])
        agree(torque_of(made.geometry, made.parameters, made.order, mine), expected[:, columns])
        kernel = ArmKernel(made)
        agree(kernel.mean(Motion.from_arrays(*mine.transpose(1, 0, 2))), expected[:, columns])


@pytest.mark.parametrize("kinds", CHAINS)
def test_regressor_of_masses_is_that_of_pinocchio(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 2)
    n = len(kinds)
    asked, data = motions(n, 3), robot.model.createData()
    out = np.empty((len(asked), 10 * n, n))
    arm_masses(geometry.constants, geometry.gravity, np.arange(n), asked, out)
    expected = [pin.computeJointTorqueRegressor(robot.model, data, *motion).copy() for motion in asked]
    agree(out.transpose(0, 2, 1), np.array(expected).reshape(len(asked), n, 10 * n))
    agree(out.transpose(0, 2, 1) @ bodies.reshape(-1), inverse_dynamics(robot, *asked.transpose(1, 0, 2)))


@pytest.mark.each_once
@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("kinds", CHAINS)
def test_derivatives_by_geometry_are_those_of_the_lagrangian(kinds: str, gravity: bool) -> None:
    geometry, bodies, _ = arm(kinds, 4, gravity)
    n, asked = len(kinds), motions(len(kinds), 5, size=2)
    found = np.empty((len(asked), geometry.size, n))
    arm_shapes(geometry.constants, geometry.gravity, bodies, np.arange(n), asked, found)
    nowhere = torch.zeros(geometry.size, dtype=torch.float64)
    torque = torque_of(geometry, bodies, np.arange(n), asked)
    for each, slopes, motion in zip(torque, found, asked, strict=True):
        agree(each, lagrangian_torque(geometry, bodies, nowhere, motion).numpy())
        if geometry.size:
            slope = jacrev(lambda step, at=motion: lagrangian_torque(geometry, bodies, step, at))(nowhere)
            np.testing.assert_allclose(slopes, slope.numpy().T, rtol=0, atol=EXACT * np.abs(torque).max() * 10)


@pytest.mark.parametrize("kinds", CHAINS)
def test_energies_and_their_derivatives(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 8)
    n, asked, data = len(kinds), motions(len(kinds), 9), robot.model.createData()
    out = np.empty((len(asked), 2, 11 * n + geometry.size))
    arm_energies(geometry.constants, geometry.gravity, bodies, np.arange(n), asked, out)
    kinetic, potential = (out[:, part, : 10 * n] @ bodies.reshape(-1) for part in (0, 1))
    agree(kinetic, np.array([pin.computeKineticEnergy(robot.model, data, q, dq) for q, dq, _ in asked]))
    agree(potential, np.array([pin.computePotentialEnergy(robot.model, data, q) for q, _, _ in asked]))
    agree(out[:, 0, 10 * n : 11 * n], 0.5 * asked[:, 1] ** 2)  # of a rotor
    assert not out[:, 1, 10 * n : 11 * n].any()
    nowhere = torch.zeros(geometry.size, dtype=torch.float64)
    for found, (q, dq, _) in zip(out[:, :, 11 * n :], asked, strict=True):
        slopes = jacrev(lambda step, at=q, v=dq: energies(geometry, bodies, step, tensor(at), tensor(v)))(nowhere)
        for part, slope in zip(found, slopes, strict=True):
            np.testing.assert_allclose(part, slope.numpy(), rtol=1e-9, atol=1e-9)
