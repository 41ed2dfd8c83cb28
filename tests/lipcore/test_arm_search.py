"""An arm found from nothing but its motion and torque, or a clear refusal where a recording tells too little."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from lipcore import FitOptions, Samples, load, save, train
from lipcore.arm import search as searching
from lipcore.arm.learning import learn
from lipcore.arm.posing import make_problem
from lipcore.arm.problem import Problem
from lipcore.arm.search import SearchResult, search
from lipcore.data.metrics import evaluate
from lipcore.data.signals import noise_level
from lipcore.fitting.hyperparameters import FitCancelledError, FitProgress
from lipcore.fitting.task import Task
from lipcore.kernels.geometry import Geometry
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.robots.library import Robot
from tests.lipcore.arm_oracles import arm, as_robot, recorded
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


BRIEF = FitOptions(device="cpu", search_seconds=0.3, posterior_samples=60)
KINDS = {"R": "revolute", "P": "prismatic"}


@pytest.fixture
def fewer_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found does not matter here."""
    monkeypatch.setattr(searching, "SCREENED", 40)


def samples(kinds: str = "RRR", size: int = 60, noise: float = 0.01) -> Samples:
    return recorded(arm(kinds, 41)[2], 1, size, noise)


def still(columns: list[int]) -> Samples:
    """Some joints never move."""
    whole = samples()
    q, dq, ddq = whole.q.copy(), whole.dq.copy(), whole.ddq.copy()
    q[:, columns], dq[:, columns], ddq[:, columns] = 0.3, 0.0, 0.0
    return replace(whole, q=q, dq=dq, ddq=ddq)


CASES: dict[str, tuple[str, Callable[[], Samples]]] = {
    "a joint that never moves": ("RRR", lambda: still([1])),
    "no joint moves": ("RRR", lambda: still([0, 1, 2])),
    "constant torque": ("RRR", lambda: replace(samples(), tau=np.tile([1.0, -2.0, 0.5], (60, 1)))),
    "no torque": ("RRR", lambda: replace(samples(), tau=np.zeros((60, 3)))),
    "noise alone": ("RRR", lambda: replace(samples(), tau=np.random.default_rng(0).standard_normal((60, 3)))),
    "free of noise": ("RRR", lambda: samples(noise=0.0)),
    "ten samples": ("RRR", lambda: samples(size=10)),
    "the same sample again and again": ("RRR", lambda: samples().rows(np.zeros(20, np.int64))),
    "revolute declared prismatic": ("RPR", samples),
    "prismatic declared revolute": ("RRR", lambda: samples("RPR")),
    "one joint": ("R", lambda: samples("R")),
    "one joint that slides": ("P", lambda: samples("P")),
    "torques in another unit": ("RRR", lambda: replace(samples(), tau=1e6 * samples().tau)),
    "an angle in degrees": ("RRR", lambda: replace(samples(), q=np.degrees(samples().q))),
}


@pytest.mark.parametrize(
    ("name", "convention"),
    [
        *((name, "gravity_included") for name in CASES),
        *((name, "gravity_compensated") for name in ("no joint moves", "no torque", "ten samples", "one joint")),
    ],
)
@pytest.mark.usefixtures("fewer_starts")
def test_it_ends_in_a_model_or_a_clear_refusal(name: str, convention: str, tmp_path: Path) -> None:
    kinds, make = CASES[name]
    data = make()
    try:
        model = train(data, [KINDS[kind] for kind in kinds], "rigid-body", BRIEF, convention)
    except (ValueError, NotPositiveDefiniteError):
        return
    answer = model.predict(data.q, data.dq, data.ddq, covariance=True)
    for part in (answer.tau, answer.tau_std, answer.covariance, answer.noise_std):
        assert np.isfinite(part).all()
    assert (answer.noise_std > 0).all()
    elsewhere = model.predict(data.q + 1.0, 2 * data.dq + 0.1, data.ddq - 1.0)
    assert np.isfinite(elsewhere.tau).all()
    assert np.isfinite(elsewhere.tau_std).all()
    save(model, tmp_path / "model")
    again = load(tmp_path / "model").predict(data.q, data.dq, data.ddq)
    largest = np.abs(answer.tau).max(initial=1e-9)
    np.testing.assert_allclose(again.tau, answer.tau, rtol=1e-6, atol=1e-6 * largest)
