"""Tests of the uncertainty of a coverage, against SciPy's exact test and simulated correlated errors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from lipcore.data.coverage import clopper_pearson, coverage_interval
from lipcore.data.metrics import TorqueDistribution
from lipcore.data.samples import Samples
from tests.lipcore.data.test_metrics import autoregressive, recording


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (17, 20), (10, 10), (850, 1000), (1, 1)])
def test_bounds_match_the_exact_binomial_test(hits: int, count: int) -> None:
    exact = binomtest(hits, count).proportion_ci(0.95, method="exact")
    low, high = clopper_pearson(np.array([hits / count]), np.array([float(count)]))
    np.testing.assert_allclose([low[0], high[0]], [exact.low, exact.high], rtol=1e-6, atol=1e-9)


def test_bounds_narrow_with_more_samples() -> None:
    _, high = clopper_pearson(np.array([0.85, 0.85]), np.array([10.0, 1000.0]))
    assert high[0] > 0.9 > high[1]


def recording_of_errors(columns: np.ndarray) -> Samples:
    """Return a recording at 100 Hz whose torque (N, n) is predicted as zero."""
    return recording(np.arange(len(columns)) / 100, columns)


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


@pytest.mark.parametrize(
    ("errors", "rows_each", "times", "expected"),
    [
        (300, 8, None, 300),
        (300, 8, np.arange(8) / 100, 300),
        (600, 2, None, 600),
        (600, 2, [0.01, 0.0], 1200),
    ],
    ids=["constant for eight rows", "constant in episodes of eight rows", "pairs", "pairs across a clock restart"],
)
def test_only_rows_of_one_course_count_once(
    errors: int, rows_each: int, times: Sequence[float] | None, expected: int
) -> None:
    columns = np.random.default_rng(2).standard_normal((errors, 4))
    samples = recording_of_errors(np.repeat(columns, rows_each, axis=0))
    if times is not None:
        samples = replace(samples, t=np.tile(times, errors))
    np.testing.assert_allclose(coverage_interval(samples, predict_zero(samples, 1.0)).independent, expected, rtol=0.15)
