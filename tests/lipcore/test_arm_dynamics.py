"""The compiled dynamics of an arm: against Pinocchio, and against the derivatives of its energies."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch
from torch.func import jacrev

from lipcore.data.motion import Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.compiled.arm import arm_energies, arm_features, arm_masses, arm_shapes, arm_torques
from lipcore.kernels.geometry import Geometry
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import inverse_dynamics
from lipcore.robots.urdf import RigidBody
from tests.lipcore.arm_oracles import arm, energies, lagrangian_torque, motions, tensor

ROBOTS = ("double-pendulum", "panda", "kinova", "tiago")
KINDS = ("RPR", "PRR", "RRP", "RRRR", "P", "R")
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
        agree(kernel.mean(Motion.from_arrays(*mine.transpose(1, 0, 2))).numpy(), expected[:, columns])


@pytest.mark.parametrize("kinds", KINDS)
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
@pytest.mark.parametrize("kinds", KINDS)
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


def test_derivatives_in_the_order_of_other_data() -> None:
    geometry, bodies, _ = arm("RPR", 6)
    order, asked = np.array([2, 0, 1]), motions(3, 7)
    straight, turned = np.empty((2, len(asked), geometry.size + 33, 3))
    given = geometry.constants, geometry.gravity, bodies
    arm_features(*given, np.arange(3), asked, straight)
    arm_features(*given, order, np.ascontiguousarray(asked[:, :, np.argsort(order)]), turned)
    for place, joint in enumerate(order):
        rows, its = slice(10 * joint, 10 * joint + 10), slice(10 * place, 10 * place + 10)
        agree(turned[:, rows][:, :, order], straight[:, its])
        agree(turned[:, 30 + joint][:, order], straight[:, 30 + place])
    agree(turned[:, 33:][:, :, order], straight[:, 33:])


@pytest.mark.parametrize("kinds", KINDS)
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
