"""Tests of right angles between axes: layouts, their probabilities, and arms without right angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lipcore.arm import right_angles
from lipcore.arm.learning import ArmFit, learn
from lipcore.arm.problem import GeometryPrior
from lipcore.arm.right_angles import (
    DIRECTIONS,
    Candidate,
    apply_layout,
    candidate_probabilities,
    expected_layout,
    right_angle_probabilities,
)
from lipcore.data.samples import Samples
from lipcore.estimators.options import FitOptions
from lipcore.estimators.task import Task
from lipcore.kernels.geometry import Geometry
from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training.fit import fit_estimator
from tests.lipcore.arm_oracles import arm, nmse_per_joint, record_motion

OPTIONS = FitOptions(posterior_samples=150, device="cpu", search_seconds=4.0)


def axes(geometry: Geometry) -> np.ndarray:
    """Return the directions of the axes at the zero pose, from base to tip."""
    turn, out = np.eye(3), []
    for rotation, axis in zip(geometry.rotation, geometry.axis, strict=True):
        turn = turn @ rotation
        out.append(turn @ axis)
    return np.array(out)


def origins(geometry: Geometry) -> np.ndarray:
    turn, place, out = np.eye(3), np.zeros(3), []
    for rotation, translation in zip(geometry.rotation, geometry.translation, strict=True):
        place, turn = place + turn @ translation, turn @ rotation
        out.append(place)
    return np.array(out)


def panda() -> Geometry:
    robot = load_robot("panda")
    return Geometry.from_robot(RigidBody.from_profile("panda", robot.joint_names, robot.joint_types), True)


def test_layout_turns_only_its_axes_and_keeps_origins() -> None:
    geometry = panda().moved(np.random.default_rng(1).normal(0, 0.1, panda().size))
    layout = (4, None, 4, 2, None, 3, 5)
    turned = apply_layout(geometry, layout)
    for joint, direction in enumerate(layout):
        wanted = axes(geometry)[joint] if direction is None else DIRECTIONS[direction]
        np.testing.assert_allclose(axes(turned)[joint], wanted, atol=1e-12)
    np.testing.assert_allclose(origins(turned), origins(geometry), atol=1e-12)


def test_layout_prior_is_narrow_only_for_its_axes() -> None:
    geometry = apply_layout(panda(), (4, None, 4, None, 4, None, 5))
    prior = expected_layout(geometry, (4, None, 4, None, 4, None, 5))
    assert isinstance(prior, GeometryPrior)
    turns = np.split(prior.widths, np.cumsum(geometry.screws)[:-1])
    for joint, widths in enumerate(turns):
        assert (widths[:2] == (right_angles.OPTIONS.turn_width_rad if joint % 2 == 0 else 1.0)).all()
    # without shifts, the geometry agrees with its own prior
    flat = replace(geometry, translation=np.zeros_like(geometry.translation))
    assert prior.value(flat) == pytest.approx(0.0, abs=1e-20)


def test_probabilities_follow_the_evidence() -> None:
    cases = [((4, 2), 0.0), ((4, None), np.log(2)), ((None, None), np.log(4))]
    found = [Candidate(layout, None, None, evidence) for layout, evidence in cases]  # type: ignore[arg-type]
    np.testing.assert_allclose(candidate_probabilities(found), np.array([4, 2, 1]) / 7)
    np.testing.assert_allclose(right_angle_probabilities(found), np.array([6, 4]) / 7)


def reported_probabilities(found: ArmFit) -> np.ndarray:
    """Return the reported probabilities of right angles, (n,)."""
    return np.array([found.report[f"right_angle_{joint + 1}"] for joint in range(found.arm.n_joints)], float)


def nmse_of_fit(found: ArmFit, task: Task, unseen: Samples) -> np.ndarray:
    return nmse_per_joint(fit_estimator(task, "rigid-body", found), unseen)


@pytest.mark.slow
def test_undetermined_axes_are_learnt_at_right_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot("panda")
    # a few seconds of moderate motion leave much of the geometry undetermined
    samples = simulate(robot, Simulation(80, rate=20.0, speed=4.0, noise=0.05, coulomb=0.2), 3)
    unseen = simulate(robot, Simulation(100, speed=6.0, coulomb=0.2), 9)
    task = Task(samples, robot.joint_types, OPTIONS)
    begin = panda().moved(np.random.default_rng(2).normal(0, 0.15, panda().size))
    found = learn(task, begin=(begin,))
    probabilities = reported_probabilities(found)
    assert (probabilities[:6] > 0.9).all(), probabilities
    off = np.abs(axes(found.arm.geometry) @ axes(found.arm.geometry).T)
    assert np.minimum(off, 1 - off)[:6, :6].max() < 0.02
    monkeypatch.setattr(right_angles, "likely_layouts", lambda *given: [])
    free = learn(task, begin=(begin,))
    assert not reported_probabilities(free).any()
    with_prior, without = (nmse_of_fit(each, task, unseen) for each in (found, free))
    assert np.log(with_prior).mean() < np.log(without).mean() - np.log(1.5)


@pytest.mark.slow
def test_arm_without_right_angles_is_learnt() -> None:
    geometry, _, robot = arm("RRRR", 7)
    samples = record_motion(robot, 4, 150)
    task = Task(samples, robot.joint_types, OPTIONS)
    found = learn(task, begin=(geometry.canonical(),))
    probabilities = reported_probabilities(found)
    assert (probabilities[1:] < 0.05).all(), probabilities
    assert nmse_of_fit(found, task, record_motion(robot, 5)).max() < 1e-2
