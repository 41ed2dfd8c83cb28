"""Tests of the uncertainty of a coverage, against SciPy's exact test and simulated correlated errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binomtest, norm

from lipcore.data.coverage import clopper_pearson, coverage_interval
from lipcore.data.metrics import TorqueDistribution
from lipcore.data.samples import Samples


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (17, 20), (10, 10), (850, 1000), (1, 1)])
def test_bounds_match_the_exact_binomial_test(hits: int, count: int) -> None:
    exact = binomtest(hits, count).proportion_ci(0.95, method="exact")
    low, high = clopper_pearson(np.array([hits / count]), np.array([float(count)]))
    np.testing.assert_allclose([low[0], high[0]], [exact.low, exact.high], rtol=1e-6, atol=1e-9)


def test_bounds_narrow_with_more_samples() -> None:
    _, high = clopper_pearson(np.array([0.85, 0.85]), np.array([10.0, 1000.0]))
    assert high[0] > 0.9 > high[1]


def recording_of_errors(columns: np.ndarray, rate: float = 100.0) -> Samples:
    """Return a recording whose torque (N, n) is predicted as zero."""
    none, rows = np.zeros_like(columns), len(columns)
    names = tuple(f"joint{k}" for k in range(columns.shape[1]))
    return Samples(names, np.arange(rows) / rate, np.zeros(rows, np.int64), none, none, none, columns)


def autoregressive(rng: np.random.Generator, rho: float, rows: int, n: int) -> np.ndarray:
    """Return errors (rows, n) of unit variance with correlation `rho` between neighbours."""
    white = rng.standard_normal((rows + 1000, n))
    return np.asarray(lfilter([np.sqrt(1 - rho**2)], [1, -rho], white, axis=0)[1000:])


def predict_zero(samples: Samples, deviation: float) -> TorqueDistribution:
    return TorqueDistribution(0 * samples.tau, 0 * samples.tau, np.full(samples.n_joints, deviation))


@pytest.mark.parametrize(("rho", "rows"), [(0.0, 300), (0.8, 1000), (0.95, 4000), (0.99, 2000)])
def test_interval_contains_the_true_coverage_despite_correlation(rho: float, rows: int) -> None:
    """The share is at least 95 %, less two standard errors of 60 joints."""
    for deviation in (1.0, 0.7):
        samples = recording_of_errors(autoregressive(np.random.default_rng(7), rho, rows, 60))
        found = coverage_interval(samples, predict_zero(samples, deviation))
        true = 2 * norm.cdf(norm.ppf(0.975) * deviation) - 1
        assert np.mean((found.low <= true) & (true <= found.high)) > 0.95 - 2 * np.sqrt(0.05 * 0.95 / 60)
        assert np.all(found.independent <= rows)


def test_effective_samples_follow_the_correlation() -> None:
    samples = recording_of_errors(autoregressive(np.random.default_rng(3), 0.9, 8000, 20))
    independent = coverage_interval(samples, predict_zero(samples, 1.0)).independent
    assert np.median(independent) == pytest.approx(8000 * 0.1 / 1.9, rel=0.2)


def test_low_coverage_is_certain_only_with_enough_errors() -> None:
    """Intervals of 70 % of the width have a coverage of 83 %."""
    rng = np.random.default_rng(5)
    few, many = (recording_of_errors(autoregressive(rng, 0.95, rows, 20)) for rows in (150, 20_000))
    assert coverage_interval(few, predict_zero(few, 0.7)).is_below(0.9).mean() < 0.2
    assert coverage_interval(many, predict_zero(many, 0.7)).is_below(0.9).all()


def test_errors_constant_over_an_episode_count_once() -> None:
    """Test episodes of eight rows whose clocks restart, and the same rows as one recording."""
    samples = recording_of_errors(np.repeat(np.random.default_rng(2).standard_normal((300, 4)), 8, axis=0))
    answer = predict_zero(samples, 1.0)
    anew = replace(samples, t=np.tile(np.arange(8) / 100, 300))
    for each in (samples, anew):
        np.testing.assert_allclose(coverage_interval(each, answer).independent, 300, rtol=0.15)


def test_rows_across_a_gap_are_independent() -> None:
    """The second of two equal rows comes after a gap or a restart of the clock, so both count."""
    samples = recording_of_errors(np.repeat(np.random.default_rng(2).standard_normal((600, 1)), 2, axis=0))
    answer = predict_zero(samples, 1.0)
    assert coverage_interval(samples, answer).independent[0] == pytest.approx(600, rel=0.15)
    anew = replace(samples, t=np.tile([0.01, 0.0], 600))
    assert coverage_interval(anew, answer).independent[0] == pytest.approx(1200, rel=0.15)
