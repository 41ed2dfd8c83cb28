"""Tests of torques in the frames of the joints, against Pinocchio and the formulas in the frame of the base."""

import numpy as np
import pinocchio as pin
import pytest

from lipcore.export.c_weights import axes_of, move_parameters
from lipcore.kernels.base import State
from lipcore.kernels.graph import Graph, Program
from lipcore.kernels.joint_frames import links_of, torque
from lipcore.kernels.newton_euler import linearised_torque
from tests.choosing import few
from tests.lipcore.arm_oracles import arm, random_bodies, random_motions

KINDS = ["RRRRRRR", "RPRPR", "PPR", "P", "R"]


def turn_of(q: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(q), np.cos(q)])


@pytest.mark.parametrize("kinds", KINDS)
def test_torques_are_those_of_pinocchio(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 3)
    frames = links_of(geometry, np.zeros(0), bodies, 0 * bodies)
    for q, dq, ddq in random_motions(len(kinds), 4):
        expected = pin.rnea(robot.model, robot.model.createData(), robot.configuration(q), dq, ddq)
        found = [each.value for each in torque(*frames, q, dq, ddq, turn_of(q))]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("kinds", few(KINDS, kept=lambda kinds: len(kinds) > 3))
def test_change_is_the_linear_one(kinds: str) -> None:
    geometry, bodies, _ = arm(kinds, 5)
    change, more = random_bodies(len(kinds), 6), random_bodies(1, 7)[0]
    step = np.random.default_rng(8).normal(0, 0.1, geometry.size)
    frames = links_of(geometry, step, bodies, change)
    loaded = bodies.copy()
    loaded[-1] += move_parameters(axes_of(geometry)[-1], np.zeros(3), more)
    for motion in random_motions(len(kinds), 9):
        expected = linearised_torque(geometry, loaded + change, State(*motion), loaded, step)
        found = [each.value + each.change for each in torque(*frames, *motion, turn_of(motion[0]), more)]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_parallel_axes_need_no_common_normal() -> None:
    """An angle of 1e-9 rad between two axes puts their common normal 1e9 m away."""
    geometry, bodies, _ = arm("RRR", 10)
    geometry.rotation[1] = [[1.0, 0.0, 0.0], [0.0, 1.0, -1e-9], [0.0, 1e-9, 1.0]]
    geometry.axis[:] = [0.0, 0.0, 1.0]
    q, dq, ddq = random_motions(3, 11)[0]
    motion = State(q, dq, ddq)
    expected = linearised_torque(geometry, bodies, motion, bodies, np.zeros(geometry.size))
    frames = links_of(geometry, np.zeros(0), bodies, 0 * bodies)
    found = [each.value for each in torque(*frames, q, dq, ddq, turn_of(q))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_an_arm_of_seven_joints_needs_less_than_a_thousand_operations() -> None:
    geometry, bodies, _ = arm("RRRRRRR", 12)
    frames, graph = links_of(geometry, np.zeros(0), bodies, 0 * bodies), Graph()
    q, dq, ddq, *turn = (graph.inputs(7) for _ in range(5))
    program = Program.of([each.value for each in torque(*frames, q, dq, ddq, turn)])
    assert len(program.operations) < 1000
