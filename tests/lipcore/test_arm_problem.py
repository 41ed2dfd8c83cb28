"""The evidence of a geometry against dense Gaussian densities, its descent, and the scales that are fitted to it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lipcore import FitOptions
from lipcore.arm.posing import make_problem
from lipcore.arm.problem import NOISE_WIDTH, Point, Problem, root_of
from lipcore.arm.scales import _Evidence, rescale
from lipcore.kernels.geometry import Geometry
from lipcore.robots.library import load_robot
from lipcore.robots.urdf import RigidBody
from tests.lipcore.arm_oracles import arm, recorded

KINDS = "RPR"


@pytest.fixture(scope="module")
def learnt() -> tuple[Problem, Point]:
    """Few samples of an arm of which nothing is known, near its true geometry."""
    geometry, _, robot = arm(KINDS, 21)
    samples = recorded(robot, 1, size=12, noise=0.05)
    problem, _ = make_problem(samples, robot.joint_types, FitOptions(device="cpu"), True)
    rng = np.random.default_rng(0)
    near = geometry.canonical().moved(rng.normal(0, 0.02, geometry.size)).canonical()
    return problem, problem.at(near, np.array([0.4, 0.3, 0.2]))


@pytest.fixture(scope="module")
def calibrated() -> tuple[Problem, Point]:
    """The same of a robot whose URDF is known, prior means and all."""
    robot = load_robot("double-pendulum")
    body = RigidBody.from_profile(robot.name, robot.joint_names, robot.joint_types)
    samples = recorded(robot, 2, size=12, noise=0.01, viscous=0.02)
    problem, _ = make_problem(samples, robot.joint_types, FitOptions(device="cpu"), True, body)
    geometry = Geometry.from_robot(body)
    geometry = geometry.moved(np.random.default_rng(1).normal(0, 0.01, geometry.size))
    return problem, problem.at(geometry, np.array([0.02, 0.03]))


@pytest.fixture(params=["learnt", "calibrated"])
def case(request: pytest.FixtureRequest) -> tuple[Problem, Point]:
    found: tuple[Problem, Point] = request.getfixturevalue(request.param)
    return found


def dense(problem: Problem, features: np.ndarray, mean: np.ndarray, std: np.ndarray, sigma: np.ndarray) -> float:
    """−log N(τ; Φ μ, Φ diag s² Φᵀ + R) without its constant; R: σ² over the samples that a row stands for."""
    flat = features.reshape(-1, features.shape[2])
    noise = (sigma**2 / problem.counts[:, None]).reshape(-1)
    covariance = (flat * std**2) @ flat.T + np.diag(noise)
    log_density = multivariate_normal.logpdf(problem.tau.reshape(-1), flat @ mean, covariance)
    # a row counted c times has the density's power c: c log σ instead of log σ / √c
    counted = ((problem.counts - 1) * np.log(sigma).sum() + 0.5 * len(sigma) * np.log(problem.counts)).sum()
    return float(-log_density - 0.5 * flat.shape[0] * np.log(2 * np.pi) + counted)


def plain_features(problem: Problem, geometry: Geometry) -> np.ndarray:
    return problem.features(geometry) / problem.scale


def off_noise(problem: Problem, sigma: np.ndarray) -> float:
    return float(0.5 * np.sum((np.log(sigma / problem.noise) / NOISE_WIDTH) ** 2))


def off_geometry(problem: Problem, geometry: Geometry) -> float:
    expected = problem.expected
    assert expected is not None
    return float(0.5 * np.sum((expected.step(geometry) / expected.widths) ** 2))


@pytest.mark.parametrize("count", [1.0, 0.3])
def test_evidence_is_the_density_of_the_torque(case: tuple[Problem, Point], count: float) -> None:
    problem, point = case
    problem = replace(problem, counts=np.linspace(count, 1.0, len(problem.tau)))
    features = plain_features(problem, point.geometry)
    expected = dense(problem, features, problem.centre, problem.scale, point.sigma)
    expected += off_noise(problem, point.sigma) + off_geometry(problem, point.geometry)
    assert problem.at(point.geometry, point.sigma).value == pytest.approx(expected, abs=1e-5)


def test_weights_are_the_posterior_mean(case: tuple[Problem, Point]) -> None:
    problem, point = case
    features = plain_features(problem, point.geometry).reshape(-1, len(problem.scale))
    noise = np.tile(point.sigma**2, len(problem.tau))
    gain = (problem.scale**2)[:, None] * features.T
    left = problem.tau.reshape(-1) - features @ problem.centre
    expected = problem.centre + gain @ np.linalg.solve(features @ gain + np.diag(noise), left)
    np.testing.assert_allclose(problem.weights(point) / problem.scale, expected / problem.scale, atol=1e-5)
    np.testing.assert_allclose(problem.mean(point), problem.tau - problem.residual(point), atol=1e-9)


def test_slope_of_the_normal_equations(case: tuple[Problem, Point]) -> None:
    """That of ½ |what is left|² + ½ |d|² in θ, whose weights follow: −½ yᵀ K⁻¹ y of a dense K."""
    problem, point = case
    _, gradient, k = problem.normal(point)

    def value(geometry: Geometry) -> float:
        flat = plain_features(problem, geometry).reshape(-1, len(problem.scale))
        covariance = (flat * problem.scale**2) @ flat.T + np.diag(np.tile(point.sigma**2, len(problem.tau)))
        left = problem.tau.reshape(-1) - flat @ problem.centre
        return float(0.5 * left @ np.linalg.solve(covariance, left)) + off_geometry(problem, geometry)

    assert np.abs(gradient[:k]).max() < 1e-3 * np.abs(gradient[k:]).max()
    for index, found in enumerate(gradient[k:]):
        step = np.zeros(point.geometry.size)
        step[index] = 1e-4
        near, far = (value(point.geometry.moved(s * step)) - value(point.geometry.moved(-s * step)) for s in (1, 2))
        assert found == pytest.approx(-(8 * near - far) / 12e-4, rel=1e-4, abs=1e-3 * np.abs(gradient[k:]).max())


def test_descent_ends_no_higher_than_it_began(case: tuple[Problem, Point]) -> None:
    problem, point = case
    for noise in (True, False):
        end = problem.descend(point.geometry, point.sigma, 15, noise=noise)
        assert end.value <= point.value
        assert problem.at(end.geometry, end.sigma).value == pytest.approx(end.value, abs=1e-6)
        assert noise or np.array_equal(end.sigma, point.sigma)
    fixed = replace(problem, expected=None).descend(point.geometry, point.sigma, 5)
    np.testing.assert_array_equal(fixed.geometry.rotation, point.geometry.rotation)


def linearised(problem: Problem, point: Point, scale: np.ndarray, sigma: np.ndarray) -> float:
    """−log evidence of weights and geometry together, to first order in the latter, and the penalty of the noise."""
    expected = problem.expected
    assert expected is not None
    both = np.concatenate([plain_features(problem, point.geometry), problem.shapes(point)], axis=2)
    mean = np.concatenate([problem.centre, expected.step(point.geometry)])
    std = np.concatenate([scale, expected.widths])
    return dense(problem, both, mean, std, sigma) + off_noise(problem, sigma)


def test_scales_are_never_worse_than_before(case: tuple[Problem, Point]) -> None:
    problem, point = case
    problem = replace(problem, counts=np.full(len(problem.tau), 0.7))
    scaled = rescale(problem, point)
    before = linearised(problem, point, problem.scale, point.sigma)
    after = linearised(problem, point, scaled.problem.scale, scaled.sigma)
    assert after <= scaled.value + 1e-5  # which counts how far the scales moved, too
    assert scaled.value <= before + 1e-5
    assert after < before - 1.0
    assert (scaled.sigma >= problem.floor * (1 - 1e-12)).all()
    np.testing.assert_array_equal(scaled.problem.centre, problem.centre)


def test_slopes_of_the_scales(case: tuple[Problem, Point]) -> None:
    problem, point = case
    rng, n, k = np.random.default_rng(4), problem.n_joints, len(problem.scale)
    evidence = _Evidence.around(problem, point)
    at = np.concatenate([np.log(point.sigma), rng.normal(0, 0.3, k)])
    value, by_noise, by_scale = evidence(at[:n], at[n:])
    sigma, scale = np.exp(at[:n]), problem.scale * np.exp(at[n:])
    assert value + off_noise(problem, sigma) == pytest.approx(linearised(problem, point, scale, sigma), abs=1e-5)
    slopes = np.concatenate([by_noise, by_scale])
    for index in [*range(n), *rng.choice(k, 15, replace=False) + n]:
        step = np.zeros(n + k)
        step[index] = 1e-4
        near, far = (
            evidence((at + s * step)[:n], (at + s * step)[n:])[0]
            - evidence((at - s * step)[:n], (at - s * step)[n:])[0]
            for s in (1, 2)
        )
        assert slopes[index] == pytest.approx((8 * near - far) / 12e-4, rel=1e-5, abs=1e-4)


def test_a_matrix_that_rounding_has_spoilt_is_factored() -> None:
    rng = np.random.default_rng(5)
    alike = 1e10 * (np.ones((40, 6)) + 1e-13 * rng.standard_normal((40, 6)))
    precision = alike.T @ alike + np.eye(6)
    assert np.linalg.eigvalsh(precision)[0] < 0  # or there is nothing to test
    lower = root_of(precision)
    np.testing.assert_allclose(np.triu(lower, 1), 0, atol=0)
    assert (lower.diagonal() > 0).all()
    np.testing.assert_allclose(lower @ lower.T, precision, rtol=1e-12)
    good = np.eye(3) + 0.1
    np.testing.assert_allclose(root_of(good), np.linalg.cholesky(good))
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        root_of(np.full((2, 2), np.nan))
