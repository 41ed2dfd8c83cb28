"""Tests of torques in the frames of the joints, against Pinocchio and the formulas in the frame of the base."""

import numpy as np
import pinocchio as pin
import pytest

from lipcore.kernels.base import State
from lipcore.kernels.geometry import Geometry
from lipcore.kernels.graph import Graph, Program
from lipcore.kernels.joint_frame_features import features
from lipcore.kernels.joint_frames import links_of, torque
from lipcore.kernels.newton_euler import linearised_torque
from tests.choosing import few
from tests.lipcore.arm_oracles import arm, random_bodies, random_motions
from tests.lipcore.kernels.test_graph import evaluate

KINDS = ["RRRRRRR", "RPRPR", "PPR", "P", "R", "RPRrPR"]


def turn_of(q: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(q), np.cos(q)])


def in_own_frame(geometry: Geometry, more: np.ndarray) -> np.ndarray:
    """Return a body of the frame of `across` and `axis` in the frame of the last joint."""
    axes = np.concatenate([geometry.across[-1], geometry.axis[-1:]]).T
    inertia = pin.Inertia.FromDynamicParameters(more)
    return np.asarray(pin.SE3(axes, np.zeros(3)).act(inertia).toDynamicParameters())


@pytest.mark.parametrize("kinds", KINDS)
def test_torques_are_those_of_pinocchio(kinds: str) -> None:
    geometry, bodies, robot = arm(kinds, 3)
    frames = links_of(geometry, np.zeros(0), bodies, 0 * bodies)
    for q, dq, ddq in random_motions(len(kinds), 4):
        expected = pin.rnea(robot.model, robot.model.createData(), robot.configuration(q), dq, ddq)
        found = [each.value for each in torque(frames, q, dq, ddq, turn_of(q))]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("kinds", few(KINDS, kept=lambda kinds: len(kinds) > 3))
def test_change_is_the_linear_one(kinds: str) -> None:
    geometry, bodies, _ = arm(kinds, 5)
    change, more = random_bodies(len(kinds), 6), random_bodies(1, 7)[0]
    step = np.random.default_rng(8).normal(0, 0.1, geometry.size)
    frames = links_of(geometry, step, bodies, change)
    loaded = bodies.copy()
    loaded[-1] += in_own_frame(geometry, more)
    for motion in random_motions(len(kinds), 9):
        expected = linearised_torque(geometry, loaded + change, State(*motion), loaded, step)
        found = [each.value + each.change for each in torque(frames, *motion, turn_of(motion[0]), more)]
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
    found = [each.value for each in torque(frames, q, dq, ddq, turn_of(q))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_an_arm_of_seven_joints_needs_less_than_a_thousand_operations() -> None:
    geometry, bodies, _ = arm("RRRRRRR", 12)
    frames, graph = links_of(geometry, np.zeros(0), bodies, 0 * bodies), Graph()
    q, dq, ddq, *turn = (graph.inputs(7) for _ in range(5))
    program = Program.of([each.value for each in torque(frames, q, dq, ddq, turn)])
    assert len(program.operations) < 1000


@pytest.mark.parametrize("is_learnt", [True, False], ids=["learnt", "fixed"])
@pytest.mark.parametrize("kinds", few([*KINDS, "PRR"], kept=lambda kinds: len(kinds) > 3))
def test_features_are_the_derivatives_of_torque(kinds: str, is_learnt: bool) -> None:
    geometry, bodies, _ = arm(kinds, 13)
    n, change, more = len(kinds), random_bodies(len(kinds), 14), random_bodies(1, 15)[0]
    step = np.random.default_rng(16).normal(0, 0.1, geometry.size * is_learnt)
    graph = Graph()
    q, dq, ddq, *turn = (graph.inputs(n) for _ in range(5))
    found, weights, first = features(geometry, bodies, is_learnt, q, dq, ddq, turn, graph.inputs(10))
    program = Program.of([each for row in found for each in row])
    loaded = bodies.copy()
    loaded[-1] += in_own_frame(geometry, more)
    for motion in random_motions(n, 17):
        still = [linearised_torque(geometry, each, State(*motion), loaded, 0 * step) for each in (loaded, change)]
        moved = linearised_torque(geometry, loaded, State(*motion), loaded, step) if is_learnt else still[0]
        expected = still[1] + moved - still[0]
        unused = np.zeros(program.inputs - 5 * n - 10)
        inputs = np.concatenate([motion.ravel(), turn_of(motion[0]).ravel(), more, unused])
        values = np.reshape(evaluate(program, inputs.tolist()), (n, -1))
        torques = values @ weights.T @ np.concatenate([change.ravel(), step])
        np.testing.assert_allclose(torques, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        for row, start in zip(values, first, strict=True):
            assert not row[:start].any()


def test_features_are_as_many_as_torque_can_tell_apart() -> None:
    """Seven of each body behind a revolute joint and four of each joint's place, less at the base."""
    geometry, bodies, _ = arm("RRRRRRR", 18)
    graph = Graph()
    q, dq, ddq, *turn = (graph.inputs(7) for _ in range(5))
    found, weights, _ = features(geometry, bodies, True, q, dq, ddq, turn, graph.inputs(10))
    assert len(found[0]) == (3 + 6 * 7) + (2 + 6 * 4)
    assert np.linalg.matrix_rank(weights) == len(found[0])
    assert len(Program.of([each for row in found for each in row]).operations) < 10_000
