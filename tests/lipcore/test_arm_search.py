"""An arm found from nothing but its motion and torque."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from lipcore import FitOptions, Samples, train
from lipcore.arm.learning import learn
from lipcore.arm.posing import make_problem
from lipcore.arm.problem import Problem
from lipcore.arm.search import SearchResult, search
from lipcore.data.metrics import evaluate
from lipcore.data.signals import noise_level
from lipcore.fitting.hyperparameters import FitCancelledError, FitProgress
from lipcore.fitting.task import Task
from lipcore.kernels.geometry import Geometry
from lipcore.robots.library import Robot
from tests.lipcore.arm_oracles import as_robot, recorded
from tests.lipcore.arms import random_bodies, random_geometry

OPTIONS = FitOptions(device="cpu", search_seconds=5.0, statistics="chosen")
NOISE, VISCOUS = 0.02, 0.2
ARMS = {"RRR": 31, "RPR": 32}


class Case(NamedTuple):
    """An arm, its samples and samples of another motion."""

    geometry: Geometry
    robot: Robot
    samples: Samples
    unseen: Samples


def case(kinds: str, gravity: bool = True) -> Case:
    geometry = random_geometry(kinds, ARMS[kinds], gravity)
    robot = as_robot(geometry, random_bodies(len(kinds), ARMS[kinds]))
    samples, unseen = (recorded(robot, seed, size, NOISE, VISCOUS) for seed, size in ((1, 150), (2, 100)))
    return Case(geometry, robot, samples, unseen)


def rows(given: Case, size: int = 80) -> Problem:
    few = given.samples.rows(np.arange(len(given.samples)) % 2 == 0).rows(slice(0, size))
    return make_problem(few, given.robot.joint_types, OPTIONS, bool(given.geometry.gravity.any()))[0]


def found_in(problem: Problem, given: Case, seconds: float = 5.0, known: tuple[Geometry, ...] = ()) -> SearchResult:
    gravity = bool(given.geometry.gravity.any())
    sensor = noise_level([given.samples.tau])
    return search(problem, given.robot.joint_types, gravity, sensor, seconds, 0, known)


def true_value(problem: Problem, given: Case) -> float:
    """−log posterior of the optimum at the arm that it is."""
    geometry = given.geometry
    if geometry.gravity.any():  # the search has its base upright
        third = -geometry.gravity / np.linalg.norm(geometry.gravity)
        first = np.cross(third, [0.3, 0.5, 0.7])
        first /= np.linalg.norm(first)
        upright = np.stack([first, np.cross(third, first), third])
        rotation = geometry.rotation.copy()
        rotation[0] = upright @ rotation[0]
        geometry = replace(geometry, rotation=rotation, gravity=np.array([0.0, 0.0, -9.81]))
    return problem.descend(geometry.canonical(), np.full(problem.n_joints, NOISE), 30).value


@pytest.mark.parametrize(("kinds", "gravity"), [("RRR", True), ("RPR", True), ("RRR", False)])
def test_what_is_found_is_at_least_as_likely_as_the_truth(kinds: str, gravity: bool) -> None:
    given = case(kinds, gravity)
    problem = rows(given)
    found = found_in(problem, given)
    best = found.points[0]
    assert best.value <= true_value(problem, given) + 1.0
    assert [each.value for each in found.points] == sorted(each.value for each in found.points)
    assert found.times_best >= 1
    assert found.distinct >= len(found.points) >= 1
    assert found.ended in ("idle", "time")
    assert best.geometry.joint_types == given.robot.joint_types
    if not gravity:
        assert not best.geometry.gravity.any()


@pytest.mark.parametrize(
    ("kinds", "convention"), [("RRR", "gravity_included"), ("RPR", "gravity_included"), ("RRR", "gravity_compensated")]
)
def test_a_learnt_arm_knows_motion_that_it_never_saw(kinds: str, convention: str) -> None:
    given = case(kinds, convention == "gravity_included")
    seen: list[FitProgress] = []
    model = train(given.samples, given.robot.joint_types, "rigid-body", OPTIONS, convention, seen.append)
    answer = model.predict(given.unseen.q, given.unseen.dq, given.unseen.ddq)
    figures = evaluate(given.unseen.tau, answer.tau, answer.tau_std, answer.noise_std)
    assert (figures.nmse < 1e-3).all(), figures.nmse
    assert (figures.coverage > 0.85).all(), figures.coverage
    assert np.allclose(model.noise_std, NOISE, rtol=0.3), model.noise_std
    assert model.arm is not None
    assert model.arm.mode == model.fit["geometry"] == "learn"
    assert model.robot is None
    stages = [each.stage for each in seen]
    assert stages[0] == "geometry"
    assert stages == sorted(stages, key=("geometry", "hyperparameters", "posterior").index)
    fractions = [each.fraction for each in seen]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1
    assert [each.iteration for each in seen] == list(range(1, len(seen) + 1))


def test_a_geometry_that_is_known_is_looked_at_first() -> None:
    given = case("RRR", False)
    problem = rows(given)
    found = found_in(problem, given, seconds=1e-6, known=(given.geometry.canonical(),))
    assert (found.ended, found.starts, found.hops) == ("time", 1, 0)
    assert found.points[0].value <= true_value(problem, given) + 1.0


def test_a_search_without_time_still_ends_in_an_arm() -> None:
    given = case("RRR")
    model = train(given.samples, given.robot.joint_types, "rigid-body", replace(OPTIONS, search_seconds=1e-6))
    assert model.fit["search_ended"] == "time"
    assert model.fit["converged"] is False
    answer = model.predict(given.unseen.q, given.unseen.dq, given.unseen.ddq)
    assert np.isfinite(answer.tau).all()


@pytest.mark.parametrize("calls", [0, 5, 40])
def test_a_search_can_be_cancelled(calls: int) -> None:
    given = case("RPR")
    asked = iter(range(10**9))
    with pytest.raises(FitCancelledError, match="cancelled"):
        learn(Task(given.samples, given.robot.joint_types, OPTIONS, cancelled=lambda: next(asked) >= calls))
