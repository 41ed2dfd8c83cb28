"""Tests of the search for an arm's geometry: results, refusals, cancellation and evidence."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lipcore import FitOptions, Samples, load, save, train
from lipcore.arm import learning, right_angles, scales
from lipcore.arm import search as searching
from lipcore.arm.learning import learn
from lipcore.arm.posing import make_problem
from lipcore.arm.problem import WIDTHS, Point, Problem, root_of
from lipcore.arm.scales import _Evidence, raise_counts, rescale
from lipcore.arm.search import SearchResult, search
from lipcore.data.metrics import evaluate
from lipcore.data.signals import noise_level
from lipcore.estimators.hyperparameters import FitCancelledError, FitProgress
from lipcore.estimators.task import Task
from lipcore.kernels.arm_prior import arm_of_robot
from lipcore.kernels.geometry import Geometry
from lipcore.posterior.linalg import NotPositiveDefiniteError
from lipcore.robots.library import Robot, load_robot
from lipcore.robots.urdf import RigidBody
from tests.choosing import slow
from tests.lipcore.arm_oracles import arm, assert_predicts_finite_torque, hold_joints, record_motion
from tests.lipcore.oracles import central_difference

OPTIONS = FitOptions(device="cpu", search_seconds=5.0, statistics="chosen")
NOISE, VISCOUS = 0.02, 0.2
ARMS = {"RRR": 31, "RPR": 32}


class Case(NamedTuple):
    """An arm, its samples and the samples of another motion."""

    geometry: Geometry
    robot: Robot
    samples: Samples
    unseen: Samples

    @property
    def gravity(self) -> bool:
        return bool(self.geometry.gravity.any())


def case(kinds: str, gravity: bool = True) -> Case:
    geometry, _, robot = arm(kinds, ARMS[kinds], gravity)
    samples, unseen = (record_motion(robot, seed, size, NOISE, VISCOUS) for seed, size in ((1, 150), (2, 100)))
    return Case(geometry, robot, samples, unseen)


def problem_of_case(given: Case) -> Problem:
    types = given.robot.joint_types
    return make_problem(given.samples.rows(slice(0, None, 2)), types, np.arange(len(types)), given.gravity)


def run_search(problem: Problem, given: Case, seconds: float = 5.0, known: tuple[Geometry, ...] = ()) -> SearchResult:
    sensor = noise_level([given.samples.tau])
    return search(problem, given.robot.joint_types, given.gravity, sensor, seconds, 0, known)


def true_value(problem: Problem, given: Case) -> float:
    """Return −log posterior at the optimum for the true geometry."""
    geometry = given.geometry
    if given.gravity:  # the search assumes an upright base
        third = -geometry.gravity / np.linalg.norm(geometry.gravity)
        first = np.cross(third, [0.3, 0.5, 0.7])
        first /= np.linalg.norm(first)
        upright = np.stack([first, np.cross(third, first), third])
        rotation = geometry.rotation.copy()
        rotation[0] = upright @ rotation[0]
        geometry = replace(geometry, rotation=rotation, gravity=np.array([0.0, 0.0, -9.81]))
    return problem.descend(geometry.canonical(), np.full(problem.n_joints, NOISE), 30).value


@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "gravity"), [slow("RRR", True), ("RPR", True), slow("RRR", False)])
def test_search_is_at_least_as_likely_as_the_truth(kinds: str, gravity: bool) -> None:
    given = case(kinds, gravity)
    problem = problem_of_case(given)
    found = run_search(problem, given)
    best = found.points[0]
    assert best.value <= true_value(problem, given) + 1.0
    assert [each.value for each in found.points] == sorted(each.value for each in found.points)
    assert found.times_best >= 1
    assert found.distinct >= len(found.points) >= 1
    assert found.ended in ("idle", "time")
    assert best.geometry.joint_types == given.robot.joint_types
    if not gravity:
        assert not best.geometry.gravity.any()


@pytest.mark.slow
@pytest.mark.parametrize(("kinds", "share"), [("RRR", "included"), slow("RPR", "included"), slow("RRR", "compensated")])
def test_learnt_arm_predicts_unseen_motion(kinds: str, share: str) -> None:
    given = case(kinds, share == "included")
    seen: list[FitProgress] = []
    model = train(given.samples, given.robot.joint_types, "rigid-body", OPTIONS, f"gravity_{share}", seen.append)
    answer = model.predict(given.unseen.q, given.unseen.dq, given.unseen.ddq)
    figures = evaluate(given.unseen.tau, *answer.interval)
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
    assert [0.0, *fractions, 1.0] == sorted([0.0, *fractions, 1.0])
    assert [each.iteration for each in seen] == list(range(1, len(seen) + 1))


def test_known_geometry_is_tried_first() -> None:
    given = case("RRR", False)
    problem = problem_of_case(given)
    found = run_search(problem, given, seconds=1e-6, known=(given.geometry.canonical(),))
    assert (found.ended, found.starts, found.hops) == ("time", 1, 0)
    assert found.points[0].value <= true_value(problem, given) + 1.0


@pytest.mark.slow
def test_search_without_time_returns_an_arm() -> None:
    given = case("RRR")
    model = train(given.samples, given.robot.joint_types, "rigid-body", replace(OPTIONS, search_seconds=1e-6))
    assert model.fit["search_ended"] == "time"
    assert model.fit["converged"] is False
    answer = model.predict(given.unseen.q, given.unseen.dq, given.unseen.ddq)
    assert np.isfinite(answer.tau).all()


@pytest.mark.parametrize("calls", [slow(0), 5, slow(40)])
def test_search_can_be_cancelled(calls: int) -> None:
    given = case("RPR")
    polls = iter(range(10**9))
    with pytest.raises(FitCancelledError, match="cancelled"):
        learn(Task(given.samples, given.robot.joint_types, OPTIONS, cancelled=lambda: next(polls) >= calls))


BRIEF_OPTIONS = FitOptions(device="cpu", search_seconds=0.3, posterior_samples=60)
KINDS = {"R": "revolute", "P": "prismatic"}


def samples(kinds: str = "RRR", size: int = 60, noise: float = 0.01) -> Samples:
    return record_motion(arm(kinds, 41)[2], 1, size, noise)


CASES: dict[str, tuple[str, Callable[[], Samples]]] = {
    "a joint that never moves": ("RRR", lambda: hold_joints(samples(), [1], 0.3)),
    "no joint moves": ("RRR", lambda: hold_joints(samples(), [0, 1, 2], 0.3)),
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


FAST_CASES = ("ten samples", "prismatic declared revolute", "one joint that slides")


@pytest.mark.parametrize(
    ("name", "convention"),
    [
        *((name, "gravity_included") for name in FAST_CASES),
        *(slow(name, "gravity_included") for name in CASES if name not in FAST_CASES),
        ("one joint", "gravity_compensated"),
        *(slow(name, "gravity_compensated") for name in ("no torque", "no joint moves", "ten samples")),
    ],
)
def test_awkward_data_give_a_model_or_a_refusal(
    name: str, convention: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "OPTIONS", replace(searching.OPTIONS, screened=40))  # the result does not matter
    kinds, make = CASES[name]
    data = make()
    try:
        model = train(data, [KINDS[kind] for kind in kinds], "rigid-body", BRIEF_OPTIONS, convention)
    except (ValueError, NotPositiveDefiniteError):
        return
    answer = assert_predicts_finite_torque(model, data)
    save(model, tmp_path / "model")
    again = load(tmp_path / "model").predict(data.q, data.dq, data.ddq)
    largest = np.abs(answer.tau).max(initial=1e-9)
    np.testing.assert_allclose(again.tau, answer.tau, rtol=1e-6, atol=1e-6 * largest)


@pytest.fixture(scope="module")
def learnt() -> tuple[Problem, Point]:
    """Return few samples of an unknown arm, near its true geometry."""
    geometry, _, robot = arm("RPR", 21)
    samples = record_motion(robot, 1, size=12, noise=0.05)
    problem = make_problem(samples, robot.joint_types, np.arange(3), True)
    rng = np.random.default_rng(0)
    near = geometry.canonical().moved(rng.normal(0, 0.02, geometry.size)).canonical()
    return problem, problem.at(near, np.array([0.4, 0.3, 0.2]))


@pytest.fixture(scope="module")
def calibrated() -> tuple[Problem, Point]:
    """Return the same for a robot with a known URDF, prior means included."""
    robot = load_robot("double-pendulum")
    body = RigidBody.from_profile(robot.name, robot.joint_names, robot.joint_types)
    samples = record_motion(robot, 2, size=12, noise=0.01, viscous=0.02)
    problem = make_problem(samples, robot.joint_types, np.arange(2), True, arm_of_robot(body, mode="calibrate"))
    geometry = Geometry.from_robot(body)
    geometry = geometry.moved(np.random.default_rng(1).normal(0, 0.01, geometry.size))
    return problem, problem.at(geometry, np.array([0.02, 0.03]))


@pytest.fixture(params=["learnt", "calibrated"])
def posed(request: pytest.FixtureRequest) -> tuple[Problem, Point]:
    found: tuple[Problem, Point] = request.getfixturevalue(request.param)
    return found


def dense(problem: Problem, features: np.ndarray, mean: np.ndarray, std: np.ndarray, sigma: np.ndarray) -> float:
    """Return −log N(τ; Φ μ, Φ diag s² Φᵀ + R) without its constant; R is σ² divided by the counts."""
    flat = features.reshape(-1, features.shape[2])
    noise = (sigma**2 / problem.counts).reshape(-1)
    covariance = (flat * std**2) @ flat.T + np.diag(noise)
    log_density = multivariate_normal.logpdf(problem.tau.reshape(-1), flat @ mean, covariance)
    # a torque counted c times has the density's power c: c log σ instead of log σ / √c
    counted = ((problem.counts - 1) * np.log(sigma) + 0.5 * np.log(problem.counts)).sum()
    return float(-log_density - 0.5 * flat.shape[0] * np.log(2 * np.pi) + counted)


def plain_features(problem: Problem, geometry: Geometry) -> np.ndarray:
    return problem.features(geometry) / problem.scale


def dense_torque(problem: Problem, geometry: Geometry, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return features, the torque's deviation from its prior mean, and its dense covariance K, each by row."""
    flat = plain_features(problem, geometry).reshape(-1, len(problem.scale))
    covariance = (flat * problem.scale**2) @ flat.T + np.diag(np.tile(sigma**2, len(problem.tau)))
    return flat, problem.tau.reshape(-1) - flat @ problem.centre, covariance


def geometry_penalty(problem: Problem, geometry: Geometry) -> float:
    expected = problem.expected
    assert expected is not None
    return float(0.5 * np.sum((expected.step(geometry) / expected.widths) ** 2))


@pytest.mark.parametrize("count", [1.0, 0.3])
def test_evidence_is_the_density_of_the_torque(posed: tuple[Problem, Point], count: float) -> None:
    problem, point = posed
    problem = replace(problem, counts=np.linspace(count, 1.0, problem.tau.size).reshape(problem.tau.shape))
    features = plain_features(problem, point.geometry)
    expected = dense(problem, features, problem.centre, problem.scale, point.sigma)
    expected += float(0.5 * np.sum((np.log(point.sigma / problem.noise) / WIDTHS.noise) ** 2))
    expected += geometry_penalty(problem, point.geometry)
    assert problem.at(point.geometry, point.sigma).value == pytest.approx(expected, abs=1e-5)


def test_weights_are_the_posterior_mean(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    features, left, covariance = dense_torque(problem, point.geometry, point.sigma)
    expected = problem.centre + (problem.scale**2)[:, None] * features.T @ np.linalg.solve(covariance, left)
    np.testing.assert_allclose(problem.weights(point) / problem.scale, expected / problem.scale, atol=1e-5)
    np.testing.assert_allclose(problem.mean(point), problem.tau - problem.residual(point), atol=1e-9)


def test_gradient_of_the_normal_equations(posed: tuple[Problem, Point]) -> None:
    """Compare with −½ yᵀ K⁻¹ y of a dense K, whose weights follow the geometry θ."""
    problem, point = posed
    _, gradient, k = problem.normal(point)

    def value(geometry: Geometry) -> float:
        _, left, covariance = dense_torque(problem, geometry, point.sigma)
        return float(0.5 * left @ np.linalg.solve(covariance, left)) + geometry_penalty(problem, geometry)

    assert np.abs(gradient[:k]).max() < 1e-3 * np.abs(gradient[k:]).max()
    for index, found in enumerate(gradient[k:]):
        along = np.eye(point.geometry.size)[index]
        slope = central_difference(lambda step, along=along: value(point.geometry.moved(step * along)), 1e-4)
        assert found == pytest.approx(-slope, rel=1e-4, abs=1e-3 * np.abs(gradient[k:]).max())


def test_descent_never_raises_the_objective(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    for noise in (True, False):
        end = problem.descend(point.geometry, point.sigma, 15, noise=noise)
        assert end.value <= point.value
        assert problem.at(end.geometry, end.sigma).value == pytest.approx(end.value, abs=1e-6)
        assert noise or np.array_equal(end.sigma, point.sigma)
    fixed = replace(problem, expected=None).descend(point.geometry, point.sigma, 5)
    np.testing.assert_array_equal(fixed.geometry.rotation, point.geometry.rotation)


def linearised(problem: Problem, point: Point, scale: np.ndarray) -> float:
    """Return −log evidence of weights and geometry, to first order in the latter, with tempered counts."""
    expected = problem.expected
    assert expected is not None
    both = np.concatenate([plain_features(problem, point.geometry), problem.shapes(point)], axis=2)
    mean = np.concatenate([problem.centre, expected.step(point.geometry)])
    std = np.concatenate([scale, expected.widths])
    return dense(replace(problem, counts=raise_counts(problem.counts)), both, mean, std, point.sigma)


def test_rescaling_improves_the_evidence(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    # with this floor the dense covariance can be factored
    problem = replace(problem, counts=np.full(problem.tau.shape, 0.7), floor=point.sigma)
    point = problem.with_noise(problem.at(point.geometry, point.sigma))
    scaled = rescale(problem, point)
    before = linearised(problem, point, problem.scale)
    after = linearised(problem, point, scaled.problem.scale)
    assert after <= scaled.value + 1e-5  # `scaled.value` includes the priors of the scales
    assert after < before - 1.0
    np.testing.assert_array_equal(scaled.problem.centre, problem.centre)


def problem_noise(problem: Problem, point: Point) -> np.ndarray:
    """Return the standard deviation of the residuals, with the degrees of freedom of a dense ridge, (n,)."""
    size, n = problem.tau.shape
    flat = problem.features(point.geometry).reshape(size * n, -1)
    weight = np.sqrt(problem.counts).reshape(-1) / np.tile(point.sigma, size)
    scaled = flat * weight[:, None]
    hat = scaled @ np.linalg.solve(scaled.T @ scaled + np.eye(flat.shape[1]), scaled.T)
    left = size - hat.diagonal().reshape(size, n).sum(0)
    return np.sqrt((problem.residual(point) ** 2).sum(0) / left)


def test_scales_stay_within_their_limits(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    few = replace(problem, counts=np.full(problem.tau.shape, 1e-3))
    shares = np.log(rescale(few, point).problem.scale / problem.unit)
    masses, friction = shares[: problem.bodies], shares[problem.bodies :]
    assert (np.abs(masses) <= 2 * scales.OPTIONS.max_log_share + 1e-9).all()
    assert ((friction >= np.log(scales.OPTIONS.min_friction_share) - 1e-9) & (friction <= 1e-9)).all()


def test_noise_does_not_depend_on_counts(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    few = replace(problem, counts=np.full(problem.tau.shape, 0.01))
    counted = few.at(point.geometry, point.sigma)
    np.testing.assert_allclose(few.with_noise(counted).sigma, problem_noise(few, counted), rtol=1e-6)


def test_gradient_of_the_scales(posed: tuple[Problem, Point]) -> None:
    problem, point = posed
    rng, k = np.random.default_rng(4), len(problem.scale)
    evidence = _Evidence.around(problem, point)
    at = np.log(problem.scale / problem.unit) + rng.normal(0, 0.3, k)
    value, slopes = evidence(at)
    assert value == pytest.approx(linearised(problem, point, problem.unit * np.exp(at)), abs=1e-5)
    for index in rng.choice(k, 15, replace=False):
        along = np.eye(k)[index]
        slope = central_difference(lambda step, along=along: evidence(at + step * along)[0], 1e-4)
        assert slopes[index] == pytest.approx(slope, rel=1e-5, abs=1e-4)


def test_nearly_singular_matrix_is_factored() -> None:
    rng = np.random.default_rng(5)
    alike = 1e10 * (np.ones((40, 6)) + 1e-13 * rng.standard_normal((40, 6)))
    precision = alike.T @ alike + np.eye(6)
    assert np.linalg.eigvalsh(precision)[0] < 0  # otherwise nothing is tested
    lower = root_of(precision)
    np.testing.assert_allclose(np.triu(lower, 1), 0, atol=0)
    assert (lower.diagonal() > 0).all()
    np.testing.assert_allclose(lower @ lower.T, precision, rtol=1e-12)
    good = np.eye(3) + 0.1
    np.testing.assert_allclose(root_of(good), np.linalg.cholesky(good))
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        root_of(np.full((2, 2), np.nan))


def test_distinct_optima_become_alternatives(learnt: tuple[Problem, Point]) -> None:
    problem, best = learnt
    place = np.arange(problem.n_joints)
    turned = best.geometry.moved(np.where(best.geometry.turns, 0.3, 0.1))
    other = problem.at(turned, best.sigma)
    free = (None,) * problem.n_joints
    first, second = (right_angles.weigh(problem, each, free) for each in (best, other))
    one, _ = learning._arm([first, first], place, "learn")
    assert one.alternatives == ()
    both, params = learning._arm([first, second], place, "learn")
    assert [each.geometry for each in both.alternatives] == [best.geometry, turned]
    odds = problem.laplace(best) - problem.laplace(other)
    assert both.alternatives[1].probability == pytest.approx(np.exp(odds) / (1 + np.exp(odds)), rel=1e-6, abs=1e-6)
    assert sum(each.probability for each in both.alternatives) == pytest.approx(1.0)
    assert {name: len(values) for name, values in params.items()}["noise.log_std"] == problem.n_joints
