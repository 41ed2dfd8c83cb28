"""How far a coverage is known: neighbouring errors tell the same, and 85 % of ten is not 85 % of a thousand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betaincinv

from lipcore.data.independence import residual_correlation
from lipcore.data.metrics import LEVEL, Answer, quantile
from lipcore.data.samples import Array, Samples

LARGEST_STEP = 2.0
"""Of usual steps of time; after a larger one errors count as not neighbouring."""


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

    N rows count for N / τ errors, τ the larger of the correlation times of the errors and of whether the interval
    holds them; see `residual_correlation`.
    """
    error, spread = samples.tau - answer.mean, np.hypot(answer.std, answer.noise_std)
    inside = np.abs(error) <= quantile(LEVEL) * spread
    apart = _apart(samples)
    independent = np.array(
        [
            len(samples) / max(_correlation(error[:, joint] / spread[:, joint], apart), _correlation(hits, apart))
            for joint, hits in enumerate(inside.T.astype(np.float64))
        ]
    )
    low, high = clopper_pearson(inside.mean(axis=0), independent)
    return CoverageInterval(independent, low, high)


def clopper_pearson(share: Array, count: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Confidence interval of a probability of which a `share` of `count` independent trials came true, (n,) each.

    With k = share · count and α = 1 - level: the quantiles α/2 of Beta(k, count - k + 1) and 1 - α/2 of
    Beta(k + 1, count - k) (Clopper and Pearson 1934), also where counts are not integers.
    """
    hits = share * count
    misses, tail = np.maximum(count - hits, 0.0), (1 - level) / 2
    some, others = np.maximum(hits, 1e-9), np.maximum(misses, 1e-9)  # where there are none, the bound is known
    low = np.where(hits > 1e-9, betaincinv(some, misses + 1, tail), 0.0)
    high = np.where(misses > 1e-9, betaincinv(hits + 1, others, 1 - tail), 1.0)
    return low, high


def _correlation(values: Array, samples: Samples) -> float:
    """Rows that one independent row of these values (N,) counts for."""
    return residual_correlation((values - values.mean())[:, None], samples)


def _apart(samples: Samples) -> Samples:
    """The samples with a new episode wherever time steps back or too far; thinning, which is even, is no gap."""
    steps = np.diff(samples.t)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    begins = (steps <= 0) | (steps > LARGEST_STEP * usual)
    return replace(samples, episode=np.concatenate([[0], np.cumsum(begins)]).astype(np.int64))
