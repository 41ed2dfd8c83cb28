"""How good a torque model is, per joint, against held-out measurements; and which of two is better.

Whether one of two models predicts a recording better: paired differences, with a standard error that is true though
neighbouring samples are correlated.

Both models err where the motion is hard, so that the difference of their figures is taken sample by sample. A robot
moves on where it was: samples are therefore brought together in blocks of BLOCK_S seconds that never reach beyond an
episode, in whole episodes where there are enough of them, and whatever correlation is left between neighbouring blocks
widens the standard error and costs degrees of freedom. For equal models whose differences stay alike for up to 3 s, the
95 % interval misses zero in 3 to 7 % of recordings of MIN_BLOCKS seconds and more, in up to 17 % of shorter ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lipcore.data.samples import Array, Samples

LEVELS = (0.5, 0.8, 0.95, 0.99)
"""Probabilities of the intervals whose coverage and width are always given."""
RELIABILITY_LEVELS = (*(k / 20 for k in range(1, 20)), 0.99)
"""Probabilities of the reliability curve: 5, 10 … 95 and 99 %."""


@dataclass(frozen=True)
class Metrics:
    """Per-joint figures, each (n,) unless stated otherwise.

    nmse: mean squared error / variance of the measured torque; rmse: N·m; coverage: share of measurements inside the
    `level` interval, noise included; nlpd: mean negative log predictive density, nats; width: mean width of that
    interval, N·m. coverages, widths: the same at each of LEVELS, (4, n); reliability: coverage at each of
    RELIABILITY_LEVELS, (20, n): a calibrated model's equals the levels, an overconfident one's lies below them.
    """

    nmse: Array
    rmse: Array
    coverage: Array
    nlpd: Array
    width: Array
    level: float
    coverages: Array
    widths: Array
    reliability: Array


def evaluate(
    tau: Array, mean: Array, std: Array, noise_std: Array, scale: Array | float = 1.0, level: float = 0.95
) -> Metrics:
    """Compare measured torques (N, n) with predicted mean, function std (N, n) and noise std (n,) or (N, n).

    scale: (n,), factor on the half widths of intervals; the density is that of the model's own belief. nmse is NaN for
    a joint whose measured torque does not vary. Raise ValueError where shapes differ.
    """
    if mean.shape != tau.shape or std.shape != tau.shape:
        raise ValueError(f"mean has shape {mean.shape} and std {std.shape}, expected {tau.shape} as tau has")
    error = tau - mean
    total = np.sqrt(std**2 + noise_std**2)
    squared = np.mean(error**2, axis=0)
    # rounding gives a constant column a variance above zero
    variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), 0.0)
    stated = scale * total
    return Metrics(
        nmse=np.divide(squared, variance, out=np.full_like(squared, np.nan), where=variance > 0),
        rmse=np.sqrt(squared),
        coverage=_coverage(error, stated, level),
        nlpd=np.mean(negative_log_density(error, total), axis=0),
        width=_width(stated, level),
        level=level,
        coverages=np.array([_coverage(error, stated, each) for each in LEVELS]),
        widths=np.array([_width(stated, each) for each in LEVELS]),
        reliability=np.array([_coverage(error, stated, each) for each in RELIABILITY_LEVELS]),
    )


def _coverage(error: Array, total: Array, level: float) -> Array:
    """Share of errors (N, n) inside the central `level` interval of a Gaussian with std `total`: (n,)."""
    return np.asarray(np.mean(np.abs(error) <= quantile(level) * total, axis=0))


def _width(total: Array, level: float) -> Array:
    return np.asarray(np.mean(2 * quantile(level) * total, axis=0))


def negative_log_density(error: Array, std: Array) -> Array:
    """−log density of errors under Gaussians of these deviations, nats, element by element."""
    return np.asarray(0.5 * np.log(2 * np.pi * std**2) + 0.5 * (error / std) ** 2)


def quantile(level: float) -> float:
    """Half the width of a Gaussian's central `level` interval, in standard deviations: 1.96 for 0.95."""
    return NormalDist().inv_cdf(0.5 + level / 2)


LEVEL = 0.95
"""Probability of all intervals."""
BLOCK_S = 1.0
"""Length of a block, s."""
MIN_BLOCKS = 20
"""Min blocks of a verdict."""


@dataclass(frozen=True)
class Difference:
    """Mean difference of k figures, each array (k,); standard error and the half width of the 95 % interval are
    infinite with a single block. freedom: degrees of freedom of the standard error."""

    mean: Array
    standard_error: Array
    half_width: Array
    freedom: Array

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Where the interval leaves out zero, (k,)."""
        return np.asarray(np.abs(self.mean) > self.half_width)


class Answer(NamedTuple):
    """What a model predicts of N samples of n joints: mean and function std (N, n), noise std (n,) or (N, n), N·m.

    scale: (n,), factor on the half widths of its intervals.
    """

    mean: Array
    std: Array
    noise_std: Array
    scale: Array | float = 1.0

    @property
    def spread(self) -> Array:
        """Standard deviation of a measurement, (N, n), as the model believes."""
        return np.asarray(np.hypot(self.std, self.noise_std))

    @property
    def half_width(self) -> Array:
        """Half the width of its 95 % intervals, (N, n)."""
        return np.asarray(quantile(LEVEL) * self.scale * self.spread)

    def holds(self, tau: Array) -> NDArray[np.bool_]:
        """Which torques, (N, n), lie inside its 95 % intervals."""
        return np.asarray(np.abs(tau - self.mean) <= self.half_width)

    def shortfall(self, tau: Array) -> Array:
        """Return how many times wider its 95 % intervals must be to hold 95 % of each joint's torques, (n,), from 1."""
        return np.asarray(np.quantile(np.abs(tau - self.mean) / self.half_width, LEVEL, axis=0).clip(1.0))


@dataclass(frozen=True)
class Comparison:
    """The figures of a second model less those of a first: nmse, rmse (N·m), coverage and nlpd (nats) of each joint.

    nmse is NaN for a joint whose measured torque does not vary. total: of the negative log predictive density summed
    over the joints, nats a sample, and of the nMSE averaged over the joints that vary, (2,); blocks: how many blocks of
    samples the standard errors stand on.
    """

    nmse: Difference
    rmse: Difference
    coverage: Difference
    nlpd: Difference
    total: Difference
    blocks: int


@dataclass(frozen=True)
class BlockScores:
    """Scores of a model in B blocks of samples: enough to compare it later with another one on the same samples.

    rows: (B,) of each block; sums: (B, 2) over these rows, of the negative log predictive density summed over the
    joints, nats, and of squared error / variance of the torque averaged over the joints that vary, NaN where none does.
    """

    rows: NDArray[np.int64]
    sums: Array

    @classmethod
    def of(cls, samples: Samples, answer: Answer) -> BlockScores:
        """Score what a model predicts of samples (N, n)."""
        starts, tau = blocks(samples), samples.tau
        varies = np.ptp(tau, axis=0) > 0
        squared = (tau - answer.mean)[:, varies] ** 2 / tau[:, varies].var(axis=0)
        nmse = squared.mean(axis=1) if varies.any() else np.full(len(tau), np.nan)
        values = np.stack([surprise(tau, answer).sum(axis=1), nmse], axis=1)
        return cls(np.diff(starts, append=len(tau)), np.add.reduceat(values, starts, axis=0))

    def less(self, first: BlockScores) -> Difference:
        """Return the mean difference of these scores from the first's on the same blocks, a row, (2,)."""
        return of_blocks(self.rows, self.sums - first.sums)


def compare(samples: Samples, first: Answer, second: Answer) -> Comparison:
    """Compare two models on samples (N, n), each by what it predicts of them: the second's figures less the first's."""
    starts, tau = blocks(samples), samples.tau
    (squared, inside, density), (others, insides, densities) = (_figures(tau, each) for each in (first, second))
    # rounding gives a constant column a variance above zero
    variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), np.nan)
    normalised = (others - squared) / variance
    rms = np.sqrt(squared.mean(axis=0)) + np.sqrt(others.mean(axis=0))
    return Comparison(
        nmse=difference(normalised, starts),
        # a² - b² = (a - b)(a + b)
        rmse=difference(np.divide(others - squared, rms, out=np.zeros_like(squared), where=rms > 0), starts),
        coverage=difference(insides - inside, starts),
        nlpd=difference(densities - density, starts),
        total=BlockScores.of(samples, second).less(BlockScores.of(samples, first)),
        blocks=len(starts),
    )


def surprise(tau: Array, answer: Answer) -> Array:
    """Negative log predictive density of torques (N, n), nats, noise included: (N, n)."""
    return negative_log_density(tau - answer.mean, answer.spread)


def _figures(tau: Array, answer: Answer) -> tuple[Array, Array, Array]:
    """Squared error, whether the interval holds the measurement, and negative log density, (N, n) each."""
    return (tau - answer.mean) ** 2, answer.holds(tau).astype(np.float64), surprise(tau, answer)


def blocks(samples: Samples) -> NDArray[np.int64]:
    """First row of each block, rising, at most 64: beyond, neighbours become one."""
    episodes = samples.episodes()
    starts: list[int] = []
    for episode in episodes:
        if len(episodes) >= MIN_BLOCKS:
            starts.append(episode.start)
            continue
        number = np.floor((samples.t[episode] - samples.t[episode.start]) / BLOCK_S)
        starts += (episode.start + np.flatnonzero(np.diff(number, prepend=-1.0))).tolist()
    while len(starts) > 64:
        starts = starts[::2]
    return np.array(starts, np.int64)


def difference(values: Array, starts: NDArray[np.int64]) -> Difference:
    """Mean of paired differences (N, k) in B blocks that begin at the rows `starts` (B,)."""
    return of_blocks(np.diff(starts, append=len(values)), np.add.reduceat(values, starts, axis=0))


def of_blocks(rows: NDArray[np.int64], sums: Array) -> Difference:
    """Mean of paired differences of which B >= 1 blocks in their order are known: rows (B,) and sums (B, k).

    With S_b the sums and N_b the rows of the blocks, N = Σ N_b, d_b = S_b - N_b mean and ρ the correlation of
    neighbouring d_b, corrected for the bias that it has in B blocks and between 0 and 0.9:
    se² = B/(B-1) Σ d_b² / N² · (1+ρ)/(1-ρ), with B (1-ρ)/(1+ρ) - 1 degrees of freedom, at least 1.
    """
    mean, count = sums.sum(axis=0) / rows.sum(), len(rows)
    if count < 2:
        unknown = np.full_like(mean, np.inf)
        return Difference(mean, unknown, unknown, np.ones_like(mean))
    deviation = sums - rows[:, None] * mean
    squared = np.sum(deviation**2, axis=0)
    from scipy.special import stdtrit  # noqa: PLC0415 - clients import this module, and no SciPy

    neighbours = np.sum(deviation[1:] * deviation[:-1], axis=0)
    measured = np.divide(neighbours, squared, out=np.zeros_like(squared), where=squared > 0)
    correlation = np.clip(measured + (1 + 4 * np.maximum(measured, 0)) / count, 0, 0.9)
    inflation = (1 + correlation) / (1 - correlation)
    standard_error = np.sqrt(count / (count - 1) * squared * inflation) / rows.sum()
    freedom = np.maximum(count / inflation - 1, 1)
    return Difference(mean, standard_error, stdtrit(freedom, 0.5 + LEVEL / 2) * standard_error, freedom)
