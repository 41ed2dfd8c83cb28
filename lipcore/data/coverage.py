"""How far a coverage is known: neighbouring errors tell the same, and 85 % of ten is not 85 % of a thousand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import betaincinv

from lipcore.data.metrics import LEVEL, Answer
from lipcore.data.samples import Array, Samples


@dataclass(frozen=True)
class CoverageInterval:
    """Each (n,), one number a joint. independent: errors that the coverage of the 95 % interval of torque stands on;
    low, high: the confidence interval of that coverage, of probability LEVEL."""

    independent: Array
    low: Array
    high: Array

    def below(self, coverage: float) -> Array:
        """Whether the true coverage is lower than this one, as far as so few errors can tell: (n,)."""
        return np.asarray(self.high < coverage)


def coverage_interval(samples: Samples, answer: Answer) -> CoverageInterval:
    """How far the coverage of the 95 % interval is known from samples (N, n) in order of time, N >= 1.

    N rows count for N / τ errors, τ the larger of the correlation times of the errors, in their standard deviations,
    and of whether the interval holds them.
    """
    error, inside = (samples.tau - answer.mean) / answer.spread, answer.holds(samples.tau)
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
    """Confidence interval of a probability of which a `share` of `count` independent trials came true, (n,) each.

    With k = share · count and α = 1 - LEVEL: the quantiles α/2 of Beta(k, count - k + 1) and 1 - α/2 of
    Beta(k + 1, count - k) (Clopper and Pearson 1934), also where counts are not integers.
    """
    hits = share * count
    misses, tail = np.maximum(count - hits, 0.0), (1 - LEVEL) / 2
    some, others = np.maximum(hits, 1e-9), np.maximum(misses, 1e-9)  # where there are none, the bound is known
    low = np.where(hits > 1e-9, betaincinv(some, misses + 1, tail), 0.0)
    high = np.where(misses > 1e-9, betaincinv(hits + 1, others, 1 - tail), 1.0)
    return low, high


def _correlation(values: Array, runs: Sequence[slice]) -> float:
    """Rows that one independent row of these values (N,) counts for, at least 1: 1 + 2 Σ c_k / c_0.

    c_k is the sum of products of values less their mean that are k rows apart in one run, up to the lag at which their
    mean correlation falls to chance level: for white values below 2/√(pairs).
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
    """Rows that follow each other in time, without a step of more than two usual ones; even thinning is no gap."""
    steps = np.diff(samples.t)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    begins = np.flatnonzero((steps <= 0) | (steps > 2 * usual)) + 1
    return [slice(first, last) for first, last in pairwise([0, *begins.tolist(), len(samples)])]
