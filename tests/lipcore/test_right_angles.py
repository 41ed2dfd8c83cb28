"""Arms at right angles: which layouts are found, how they are weighed, and what is left of an arm that has none."""

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
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipcore.robots.urdf import RigidBody
from lipcore.training.fit import fit_estimator
from tests.lipcore.arm_oracles import arm, recorded

OPTIONS = FitOptions(posterior_samples=150, device="cpu", search_seconds=4.0)


def axes(geometry: Geometry) -> np.ndarray:
    """Directions of the axes at the zero pose, one after the other from base to tip."""
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


def test_a_layout_turns_its_axes_and_leaves_the_others_and_all_places() -> None:
    geometry = panda().moved(np.random.default_rng(1).normal(0, 0.1, panda().size))
    layout = (4, None, 4, 2, None, 3, 5)
    turned = apply_layout(geometry, layout)
    for joint, direction in enumerate(layout):
        wanted = axes(geometry)[joint] if direction is None else DIRECTIONS[direction]
        np.testing.assert_allclose(axes(turned)[joint], wanted, atol=1e-12)
    np.testing.assert_allclose(origins(turned), origins(geometry), atol=1e-12)


def test_a_layout_expects_its_axes_closely_and_the_others_anywhere() -> None:
    geometry = apply_layout(panda(), (4, None, 4, None, 4, None, 5))
    prior = expected_layout(geometry, (4, None, 4, None, 4, None, 5))
    assert isinstance(prior, GeometryPrior)
    turns = np.split(prior.widths, np.cumsum(geometry.screws)[:-1])
    for joint, widths in enumerate(turns):
        assert (widths[:2] == (right_angles.OPTIONS.turn_width_rad if joint % 2 == 0 else 1.0)).all()
    # of its own geometry nothing but the shifts is unexpected
    flat = replace(geometry, translation=np.zeros_like(geometry.translation))
    assert prior.value(flat) == pytest.approx(0.0, abs=1e-20)


def test_probabilities_follow_the_evidence() -> None:
    cases = [((4, 2), 0.0), ((4, None), np.log(2)), ((None, None), np.log(4))]
    found = [Candidate(layout, None, None, evidence) for layout, evidence in cases]  # type: ignore[arg-type]
    np.testing.assert_allclose(candidate_probabilities(found), np.array([4, 2, 1]) / 7)
    np.testing.assert_allclose(right_angle_probabilities(found), np.array([6, 4]) / 7)


def short_recording(robot: Robot, seed: int, rows: int = 80) -> Samples:
    """A few seconds of moderate motion with friction and noise, which leave much of the geometry open."""
    return simulate(robot, Simulation(rows, rate=20.0, speed=4.0, noise=0.05, coulomb=0.2), seed)


def certainties(found: ArmFit) -> np.ndarray:
    """How probable the report says right angles are, (n,)."""
    return np.array([found.report[f"right_angle_{joint + 1}"] for joint in range(found.arm.n_joints)], float)


def errors(found: ArmFit, task: Task, unseen: Samples) -> np.ndarray:
    """nMSE on another motion, (n,)."""
    model = fit_estimator(task, "rigid-body", found)
    error = model.predict(unseen.q, unseen.dq, unseen.ddq).tau - unseen.tau
    return np.mean(error**2, axis=0) / unseen.tau.var(axis=0)


def test_axes_that_a_short_recording_leaves_open_are_expected_at_right_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot("panda")
    samples, unseen = short_recording(robot, 3), simulate(robot, Simulation(100, speed=6.0, coulomb=0.2), 9)
    task = Task(samples, robot.joint_types, OPTIONS)
    begin = panda().moved(np.random.default_rng(2).normal(0, 0.15, panda().size))
    found = learn(task, begin=(begin,))
    sure = certainties(found)
    assert (sure[:6] > 0.9).all(), sure
    off = np.abs(axes(found.arm.geometry) @ axes(found.arm.geometry).T)
    assert np.minimum(off, 1 - off)[:6, :6].max() < 0.02
    monkeypatch.setattr(right_angles, "likely_layouts", lambda *given: [])
    free = learn(task, begin=(begin,))
    assert not certainties(free).any()
    with_prior, without = (errors(each, task, unseen) for each in (found, free))
    assert np.log(with_prior).mean() < np.log(without).mean() - np.log(1.5)


def test_an_arm_that_has_no_right_angles_is_learnt_as_it_is() -> None:
    geometry, _, robot = arm("RRRR", 7)
    samples = recorded(robot, 4, 150)
    found = learn(Task(samples, robot.joint_types, OPTIONS), begin=(geometry.canonical(),))
    sure = certainties(found)
    assert (sure[1:] < 0.05).all(), sure
    assert errors(found, Task(samples, robot.joint_types, OPTIONS), recorded(robot, 5)).max() < 1e-2
