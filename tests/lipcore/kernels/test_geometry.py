"""Tests of arm geometry and compiled dynamics against Pinocchio and derivatives of the energies."""

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
from tests.lipcore.arm_oracles import arm, energies, lagrangian_torque, random_motions, tensor
from tests.lipcore.arms import random_geometry
from tests.lipcore.robots.test_urdf import joint, link
from tests.lipcore.robots.test_urdf import robot as robot_of

KINDS = ("R", "RPR", "PRR", "RRRR", "RRpR")
ROBOTS = ("double-pendulum", "panda", "kinova", "tiago")


def assert_same_placements(geometry: Geometry, robot: Robot, seed: int) -> None:
    """Compare the frames of all joints with Pinocchio's."""
    data = robot.model.createData()
    for q in random_motions(robot.n_joints, seed)[:, 0]:
        pin.forwardKinematics(robot.model, data, robot.configuration(q))
        rotations, origins = geometry.placements(q)
        np.testing.assert_allclose(rotations, [each.rotation for each in data.oMi[1:]], atol=1e-12)
        np.testing.assert_allclose(origins, [each.translation for each in data.oMi[1:]], atol=1e-12)


def regressor(geometry: Geometry, queries: np.ndarray) -> np.ndarray:
    """Return ∂τ/∂π of motions, (N n, 10 n)."""
    n = geometry.n_joints
    out = np.empty((len(queries), 10 * n, n))
    arm_masses(geometry.constants, geometry.gravity, np.arange(n), queries, out)
    return out.transpose(0, 2, 1).reshape(-1, 10 * n)


def unexplained_share(features: np.ndarray, torque: np.ndarray) -> float:
    """Return the share of a torque that the best weights leave unexplained."""
    weights = np.linalg.lstsq(features, torque, rcond=None)[0]
    return float(np.linalg.norm(torque - features @ weights) / np.linalg.norm(torque))


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("kinds", KINDS)
def test_step_between_geometries_is_recovered(kinds: str, gravity: bool) -> None:
    geometry = random_geometry(kinds, 1, gravity)
    step = np.random.default_rng(2).uniform(-0.3, 0.3, geometry.size)
    other = geometry.moved(step)
    np.testing.assert_allclose(geometry.towards(other), step, atol=1e-12)
    np.testing.assert_allclose(geometry.towards(geometry), 0 * step, atol=1e-15)
    # the reverse step, seen from the other geometry, to first order
    for size in (1e-2, 1e-3):
        back = geometry.moved(size * step).towards(geometry)
        np.testing.assert_allclose(back, -size * step, rtol=0, atol=2 * size**2)


@pytest.mark.parametrize(
    ("kinds", "gravity", "screws"),
    [
        ("R", True, (2,)),
        ("R", False, (0,)),
        ("P", True, (2,)),
        ("RPR", True, (2, 2, 4)),
        ("PRR", False, (0, 4, 4)),
        ("RRpR", True, (2, 4, 2, 4)),
    ],
)
def test_number_of_identifiable_geometry_parameters(kinds: str, gravity: bool, screws: tuple[int, ...]) -> None:
    geometry = random_geometry(kinds, 3, gravity)
    assert geometry.screws == screws
    assert geometry.size == sum(screws) == len(geometry.turns) == len(geometry.shifts())
    assert geometry.turns.sum() == sum(min(count, 2) for count in screws)


@pytest.mark.parametrize("kinds", KINDS)
def test_canonical_arm_has_the_same_torques(kinds: str) -> None:
    """Bodies are relative to their frames, so other weights give the same torques."""
    geometry, _, robot = arm(kinds, 5)
    queries, canonical = random_motions(len(kinds), 6, size=30), geometry.canonical()
    torque = inverse_dynamics(robot, *queries.transpose(1, 0, 2)).reshape(-1)
    assert unexplained_share(regressor(geometry, queries), torque) < 1e-10
    assert unexplained_share(regressor(canonical, queries), torque) < 1e-10
    again = canonical.canonical()
    np.testing.assert_allclose(again.translation, canonical.translation, atol=1e-12)
    assert not canonical.translation[list(geometry.roots)].any()
    for j, kind in enumerate(canonical.joint_types):
        along = canonical.translation[j] @ canonical.rotation[j] @ canonical.axis[j]
        assert along == pytest.approx(0.0, abs=1e-12)
        assert kind == "revolute" or not canonical.translation[j].any()
    if len(kinds) > 1:  # another axis changes the torques
        assert unexplained_share(regressor(geometry.moved(np.full(geometry.size, 0.1)), queries), torque) > 1e-3


@pytest.mark.parametrize("name", ROBOTS)
def test_placements_match_pinocchio(name: str) -> None:
    robot = load_robot(name)
    body = RigidBody.from_profile(name, robot.joint_names, robot.joint_types)
    geometry = Geometry.from_robot(body)
    assert_same_placements(geometry, robot, 11)
    np.testing.assert_array_equal(geometry.gravity, robot.model.gravity.linear)
    assert not Geometry.from_robot(body, gravity=False).gravity.any()


def test_unaligned_axes_are_read_from_pinocchio() -> None:
    types = ("revolute", "prismatic", "revolute")
    parts = [joint(name, *name, kind=kind) for name, kind in zip(("ab", "bc", "cd"), types, strict=True)]
    tilted = [
        part.replace('"0 1 0"', axis).replace('xyz="0 0 0.3"', 'xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"')
        for part, axis in zip(parts, ('"1 2 -2"', '"2 -1 2"', '"-3 0 4"'), strict=True)
    ]
    body = RigidBody.from_urdf(robot_of(*map(link, "abcd"), *tilted), ("ab", "bc", "cd"), types)
    geometry = Geometry.from_robot(body)
    np.testing.assert_allclose(geometry.axis, np.array([[1, 2, -2], [2, -1, 2], [-1.8, 0, 2.4]]) / 3, atol=1e-12)
    assert_same_placements(geometry, Robot("odd", body.model, body.joint_names, types, *np.zeros((3, 3))), 12)


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


def test_invalid_geometry_is_rejected() -> None:
    good = random_geometry("RR", 13)
    parts = {name: getattr(good, name) for name in ("rotation", "translation", "axis", "gravity")}
    for name, value, message in (
        ("rotation", 2 * good.rotation, "not a rotation"),
        ("rotation", good.rotation[:1], "rotation has shape"),
        ("translation", np.full((2, 3), np.nan), "translation has shape"),
        ("axis", 3 * good.axis, "not of length one"),
        ("gravity", np.zeros(2), "gravity has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            Geometry(good.joint_types, **{**parts, name: value})


CHAINS = ("RPR", "PRR", "RRP", "RRRR", "P", "R", "RPRrPr")
TOLERANCE = 1e-10
"""Relative tolerance for rounding errors."""


def assert_close(found: np.ndarray, expected: np.ndarray, share: float = TOLERANCE) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * np.abs(expected).max())


def torque_of(geometry: Geometry, bodies: np.ndarray, order: np.ndarray, queries: np.ndarray) -> np.ndarray:
    out = np.empty((len(queries), geometry.n_joints))
    arm_torques(geometry.constants, geometry.gravity, np.ascontiguousarray(bodies), order, queries, out)
    return out


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("name", ROBOTS)
def test_robot_torque_matches_pinocchio(name: str, gravity: bool) -> None:
    robot = load_robot(name)
    n = robot.n_joints
    queries = random_motions(n, 1)
    expected = inverse_dynamics(robot, *queries.transpose(1, 0, 2))
    if not gravity:
        data = robot.model.createData()
        still = [pin.computeGeneralizedGravity(robot.model, data, robot.configuration(q)).copy() for q in queries[:, 0]]
        expected = expected - np.array(still)
    for seed in (None, 0, 1):
        columns = np.arange(n) if seed is None else np.random.default_rng(seed).permutation(n)
        names, types = (tuple(parts[i] for i in columns) for parts in (robot.joint_names, robot.joint_types))
        body = RigidBody.from_profile(name, names, types)
        made = arm_of_robot(body, gravity)
        mine = np.ascontiguousarray(queries[:, :, columns])
        assert_close(torque_of(made.geometry, made.parameters, made.order, mine), expected[:, columns])
        kernel = ArmKernel(made)
        assert_close(kernel.mean(Motion.from_arrays(*mine.transpose(1, 0, 2))), expected[:, columns])


@pytest.mark.parametrize("kinds", CHAINS)
def test_mass_regressor_matches_pinocchio(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 2)
    n = len(kinds)
    queries, data = random_motions(n, 3), robot.model.createData()
    found = regressor(geometry, queries).reshape(len(queries), n, 10 * n)
    expected = [pin.computeJointTorqueRegressor(robot.model, data, *motion).copy() for motion in queries]
    assert_close(found, np.array(expected).reshape(found.shape))
    assert_close(found @ bodies.reshape(-1), inverse_dynamics(robot, *queries.transpose(1, 0, 2)))


@pytest.mark.each_once
@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("kinds", CHAINS)
def test_geometry_derivatives_match_the_lagrangian(kinds: str, gravity: bool) -> None:
    geometry, bodies, _ = arm(kinds, 4, gravity)
    n, queries = len(kinds), random_motions(len(kinds), 5, size=2)
    found = np.empty((len(queries), geometry.size, n))
    arm_shapes(geometry.constants, geometry.gravity, bodies, np.arange(n), queries, found)
    no_step = torch.zeros(geometry.size, dtype=torch.float64)
    torque = torque_of(geometry, bodies, np.arange(n), queries)
    for each, slopes, motion in zip(torque, found, queries, strict=True):
        assert_close(each, lagrangian_torque(geometry, bodies, no_step, motion).numpy())
        if geometry.size:
            slope = jacrev(lambda step, at=motion: lagrangian_torque(geometry, bodies, step, at))(no_step)
            np.testing.assert_allclose(slopes, slope.numpy().T, rtol=0, atol=TOLERANCE * np.abs(torque).max() * 10)


@pytest.mark.parametrize("kinds", CHAINS)
def test_energies_and_their_derivatives(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 8)
    n, queries, data = len(kinds), random_motions(len(kinds), 9), robot.model.createData()
    out = np.empty((len(queries), 2, 11 * n + geometry.size))
    arm_energies(geometry.constants, geometry.gravity, bodies, np.arange(n), queries, out)
    kinetic, potential = (out[:, part, : 10 * n] @ bodies.reshape(-1) for part in (0, 1))
    assert_close(kinetic, np.array([pin.computeKineticEnergy(robot.model, data, q, dq) for q, dq, _ in queries]))
    assert_close(potential, np.array([pin.computePotentialEnergy(robot.model, data, q) for q, _, _ in queries]))
    assert_close(out[:, 0, 10 * n : 11 * n], 0.5 * queries[:, 1] ** 2)  # of the rotors
    assert not out[:, 1, 10 * n : 11 * n].any()
    no_step = torch.zeros(geometry.size, dtype=torch.float64)
    for found, (q, dq, _) in zip(out[:, :, 11 * n :], queries, strict=True):
        slopes = jacrev(lambda step, at=q, v=dq: energies(geometry, bodies, step, tensor(at), tensor(v)))(no_step)
        for part, slope in zip(found, slopes, strict=True):
            np.testing.assert_allclose(part, slope.numpy(), rtol=1e-9, atol=1e-9)
