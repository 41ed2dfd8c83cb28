"""Tests of the external torque against dense matrices, SciPy's distributions and random draws."""

import numpy as np
import pytest
from scipy import stats

from lipcore.model.external import external

SEED = 7


def random_uncertainty(n: int, count: int) -> tuple[np.ndarray, ...]:
    """Return covariances (N, n, n), their std, noise and scale (n,), in units as far apart as wrist and shoulder."""
    draw = np.random.default_rng(SEED)
    root = draw.normal(size=(count, n, n + 2)) * np.geomspace(0.01, 1.0, n)[:, None]
    covariance = root @ root.transpose(0, 2, 1)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return covariance, std, draw.uniform(0.01, 1.0, n), draw.uniform(0.3, 3.0, n)


def total_covariance(covariance: np.ndarray, noise_std: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the total covariance C, (N, n, n), by its definition."""
    return np.diag(scale) @ (covariance + np.diag(noise_std**2)) @ np.diag(scale)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 7, 8])
def test_statistics_match_dense_matrices(n: int) -> None:
    covariance, std, noise_std, scale = random_uncertainty(n, 20)
    draw = np.random.default_rng(n)
    mean = draw.normal(size=(20, n))
    tau = mean + draw.normal(size=(20, n)) * np.geomspace(0.01, 10.0, 20)[:, None]
    seen = external(tau, mean, std, noise_std, scale, covariance)
    error, total = tau - mean, total_covariance(covariance, noise_std, scale)
    spread = np.sqrt(np.diagonal(total, axis1=1, axis2=2))
    np.testing.assert_allclose(seen.tau, error, rtol=1e-12)
    np.testing.assert_allclose(seen.std, spread, rtol=1e-12)
    np.testing.assert_allclose(seen.z, error / spread, rtol=1e-12)
    expected = np.einsum("ki,kij,kj->k", error, np.linalg.inv(total), error)
    np.testing.assert_allclose(seen.statistic, expected, rtol=1e-8)
    np.testing.assert_allclose(seen.p, stats.chi2.sf(seen.statistic, n), rtol=1e-11, atol=1e-300)
    assert (seen.statistic >= (seen.z**2).max(axis=1) * (1 - 1e-9)).all()
    np.testing.assert_array_equal(seen.rows, np.column_stack([seen.tau, seen.std, seen.z, seen.statistic, seen.p]))
    np.testing.assert_array_equal(external(tau, mean, std, noise_std, scale).rows, seen.rows[:, : 3 * n])


@pytest.mark.parametrize("n", [1, 2, 7, 8])
def test_probability_is_accurate_to_the_far_tail(n: int) -> None:
    tau = np.zeros((60, n))
    tau[:, 0] = np.sqrt(np.geomspace(1e-6, 1200.0, 60))
    same = np.broadcast_to(np.eye(n), (60, n, n))
    seen = external(tau, np.zeros_like(tau), np.ones_like(tau), np.zeros(n), None, same)
    np.testing.assert_allclose(seen.statistic, tau[:, 0] ** 2, rtol=1e-12)
    np.testing.assert_allclose(seen.p, stats.chi2.sf(tau[:, 0] ** 2, n), rtol=1e-11)


@pytest.mark.parametrize("n", [2, 7])
def test_false_alarms_occur_at_the_stated_rate(n: int) -> None:
    count = 20_000
    (covariance,), (std,), noise_std, scale = random_uncertainty(n, 1)
    total = total_covariance(covariance, noise_std, scale)
    error = np.random.default_rng(SEED).multivariate_normal(np.zeros(n), total, count)
    std, covariance = np.tile(std, (count, 1)), np.tile(covariance, (count, 1, 1))
    seen = external(error, np.zeros_like(error), std, noise_std, scale, covariance)
    assert stats.kstest(seen.p, "uniform").pvalue > 0.01
    for level in (0.05, 0.01):
        alarms = np.column_stack([seen.p < level, np.abs(seen.z) > stats.norm.isf(level / 2)])
        assert np.abs(alarms.mean(axis=0) - level).max() < 4 * np.sqrt(level * (1 - level) / count)


def test_correlation_of_joints_reveals_a_push() -> None:
    """Two joints err alike; a push acts against that correlation."""
    covariance = np.array([[[1.0, 0.99], [0.99, 1.0]]])
    given = np.zeros((1, 2)), np.ones((1, 2)), np.full(2, 0.05), None, covariance
    alike, against = external(np.array([[1.0, 1.0]]), *given), external(np.array([[1.0, -1.0]]), *given)
    np.testing.assert_array_equal(np.abs(alike.z), np.abs(against.z))
    assert np.abs(against.z).max() < 1.0
    assert alike.p > 0.5
    assert against.p < 1e-20


def test_huge_and_nan_torques_are_not_finite() -> None:
    tau = np.array([[1e300, 0.0], [np.nan, 0.0]])
    given = np.zeros((2, 2)), np.ones((2, 2)), np.ones(2), None, np.tile(np.eye(2), (2, 1, 1))
    assert not np.isfinite(external(tau, *given).statistic).any()
