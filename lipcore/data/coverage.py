"""The confidence interval of a coverage. Neighbouring errors are correlated, so N rows are fewer effective samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import betaincinv

from lipcore.data.metrics import LEVEL, TorqueDistribution
from lipcore.data.samples import Array, Samples


@dataclass(frozen=True)
class CoverageInterval:
    """Confidence interval of the coverage of the 95 % interval of torque, of probability LEVEL. Each array is (n,)."""

    independent: Array
    """Number of effective samples."""
    low: Array
    high: Array

    def is_below(self, coverage: float) -> Array:
        """Return whether the true coverage is below `coverage`, with confidence: (n,)."""
        return np.asarray(self.high < coverage)


def coverage_interval(samples: Samples, answer: TorqueDistribution) -> CoverageInterval:
    """Return the confidence interval of the coverage on samples (N, n) in order of time, N >= 1.

    N rows are N / τ effective samples. τ is the larger of two correlation times, in rows: of the errors divided by
    their standard deviations, and of whether the interval contains them.
    """
    error, inside = (samples.tau - answer.mean) / answer.spread, answer.contains(samples.tau)
    runs = _runs(samples)
    independent = np.array(
        [
            len(samples) / max(_correlation(error[:, joint], runs), _correlation(hits, runs))
            for joint, hits in enumerate(inside.T.astype(np.float64))
        ]
    )
    low, high = clopper_pearson(inside.mean(axis=0), independent)
    return CoverageInterval(independent, low, high)


def clopper_pearson(share: Array, count: Array) -> tuple[Array, Array]:
    """Return the confidence interval of a probability with a `share` of hits in `count` trials, (n,) each.

    With k = share · count and α = 1 - LEVEL: the quantiles α/2 of Beta(k, count - k + 1) and 1 - α/2 of
    Beta(k + 1, count - k) (Clopper and Pearson 1934). Counts need not be integers.
    """
    hits = share * count
    misses, tail = np.maximum(count - hits, 0.0), (1 - LEVEL) / 2
    some, others = np.maximum(hits, 1e-9), np.maximum(misses, 1e-9)  # without hits or misses the bound is 0 or 1
    low = np.where(hits > 1e-9, betaincinv(some, misses + 1, tail), 0.0)
    high = np.where(misses > 1e-9, betaincinv(hits + 1, others, 1 - tail), 1.0)
    return low, high


def _correlation(values: Array, runs: Sequence[slice]) -> float:
    """Return the correlation time of values (N,), in rows, at least 1: 1 + 2 Σ c_k / c_0.

    c_k is the sum of products of centred values that are k rows apart in one run. The sum over k ends at the lag at
    which their mean correlation falls to chance level, which is 2/√(pairs) for white values.
    """
    centred = values - values.mean()
    longest = max(run.stop - run.start for run in runs)
    sums, pairs = np.zeros(longest), np.zeros(longest)
    for run in runs:
        part = centred[run]
        rows = len(part)
        sums[:rows] += np.fft.irfft(np.abs(np.fft.rfft(part, 2 * rows)) ** 2, 2 * rows)[:rows]
        pairs[:rows] += np.arange(rows, 0, -1)
    if sums[0] <= 0:
        return 1.0
    chance = np.flatnonzero(sums / pairs < 2 / np.sqrt(pairs) * sums[0] / pairs[0])
    end = chance[0] if len(chance) else longest
    return float(1 + 2 * sums[1:end].sum() / sums[0])


def _runs(samples: Samples) -> list[slice]:
    """Return the runs of rows that follow each other in time, split at steps of more than two usual steps.

    The usual step is the median, so evenly thinned rows form one run.
    """
    steps = np.diff(samples.t)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    begins = np.flatnonzero((steps <= 0) | (steps > 2 * usual)) + 1
    return [slice(first, last) for first, last in pairwise([0, *begins.tolist(), len(samples)])]
