"""Metrics of a torque model per joint, and the comparison of two models on the same samples.

A comparison uses paired differences. Both models err where the motion is hard, so their figures are subtracted sample
by sample. Neighbouring samples are correlated, so samples are grouped in blocks of BLOCK_S seconds within an episode,
or in whole episodes if there are enough. Correlation between neighbouring blocks widens the standard error and costs
degrees of freedom.

Measured for equal models with differences that stay alike for up to 3 s: the 95 % interval misses zero in 3 to 7 % of
recordings of at least MIN_BLOCKS seconds. In shorter recordings it misses zero in up to 17 %.
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
"""Probabilities of the intervals; their coverage and width are always returned."""
RELIABILITY_LEVELS = (*(k / 20 for k in range(1, 20)), 0.99)
"""Probabilities of the reliability curve: 5, 10 … 95 and 99 %."""


@dataclass(frozen=True)
class Metrics:
    """Metrics per joint, each (n,) unless stated otherwise."""

    nmse: Array
    """Mean squared error / variance of the measured torque."""
    rmse: Array
    """N·m (N)."""
    coverage: Array
    """Share of measurements inside the `level` interval, noise included."""
    nlpd: Array
    """Mean negative log predictive density, nats."""
    width: Array
    """Mean width of the `level` interval, N·m (N)."""
    level: float
    coverages: Array
    """Coverage at each of LEVELS, (4, n)."""
    widths: Array
    """Width at each of LEVELS, (4, n)."""
    reliability: Array
    """Coverage at each of RELIABILITY_LEVELS, (20, n). A calibrated model has the levels, an overconfident one less."""


def evaluate(
    tau: Array, mean: Array, std: Array, noise_std: Array, scale: Array | float = 1.0, level: float = 0.95
) -> Metrics:
    """Return the metrics of predicted torques (N, n) against measured ones.

    std: (N, n) of the function; noise_std: (n,) or (N, n); scale: (n,) factor on the half widths of intervals, but not
    on the density. nmse is NaN for a joint with constant measured torque. Raise ValueError if shapes differ.
    """
    if mean.shape != tau.shape or std.shape != tau.shape:
        raise ValueError(f"mean has shape {mean.shape} and std {std.shape}, expected {tau.shape}, the shape of tau")
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
    """Return the share of errors (N, n) inside the central `level` interval of a Gaussian with std `total`: (n,)."""
    return np.asarray(np.mean(np.abs(error) <= quantile(level) * total, axis=0))


def _width(total: Array, level: float) -> Array:
    return np.asarray(np.mean(2 * quantile(level) * total, axis=0))


def negative_log_density(error: Array, std: Array) -> Array:
    """Return −log density of errors under Gaussians of these deviations, nats, element by element."""
    return np.asarray(0.5 * np.log(2 * np.pi * std**2) + 0.5 * (error / std) ** 2)


def quantile(level: float) -> float:
    """Return half the width of a Gaussian's central `level` interval, in standard deviations: 1.96 for 0.95."""
    return NormalDist().inv_cdf(0.5 + level / 2)


LEVEL = 0.95
"""Probability of all intervals."""
BLOCK_S = 1.0
"""Length of a block, s."""
MIN_BLOCKS = 20
"""Min blocks of a verdict."""


@dataclass(frozen=True)
class Difference:
    """Mean difference of k figures, each array (k,)."""

    mean: Array
    standard_error: Array
    """Infinite with a single block."""
    half_width: Array
    """Half the width of the 95 % interval, infinite with a single block."""
    freedom: Array
    """Degrees of freedom of the standard error."""

    @property
    def significant(self) -> NDArray[np.bool_]:
        """Return whether the interval excludes zero, (k,)."""
        return np.asarray(np.abs(self.mean) > self.half_width)


class TorqueDistribution(NamedTuple):
    """Predicted torque at N samples of n joints, N·m (N): mean and function std (N, n), noise std (n,) or (N, n)."""

    mean: Array
    std: Array
    noise_std: Array
    scale: Array | float = 1.0
    """Factor on the half widths of the intervals, (n,)."""

    @property
    def spread(self) -> Array:
        """Return the standard deviation of a measurement before `scale`, (N, n)."""
        return np.asarray(np.hypot(self.std, self.noise_std))

    @property
    def half_width(self) -> Array:
        """Return half the width of the 95 % intervals, (N, n)."""
        return np.asarray(quantile(LEVEL) * self.scale * self.spread)

    def contains(self, tau: Array) -> NDArray[np.bool_]:
        """Return which torques (N, n) lie inside the 95 % intervals."""
        return np.asarray(np.abs(tau - self.mean) <= self.half_width)

    def width_factor(self, tau: Array) -> Array:
        """Return the factor, at least 1, with which 95 % intervals contain 95 % of each joint's torques, (n,)."""
        return np.asarray(np.quantile(np.abs(tau - self.mean) / self.half_width, LEVEL, axis=0).clip(1.0))


@dataclass(frozen=True)
class Comparison:
    """Metrics of a second model minus those of a first, per joint."""

    nmse: Difference
    """NaN for a joint with constant measured torque."""
    rmse: Difference
    """N·m (N)."""
    coverage: Difference
    nlpd: Difference
    """Nats."""
    total: Difference
    """Of the negative log predictive density summed over the joints, nats a sample, and of the nMSE averaged over
    the joints with varying torque: (2,)."""
    blocks: int
    """Number of blocks of samples behind the standard errors."""


@dataclass(frozen=True)
class BlockScores:
    """Scores of a model in B blocks of samples, for a later comparison with another model on the same samples."""

    rows: NDArray[np.int64]
    """Number of rows of each block, (B,)."""
    sums: Array
    """Sums over the rows of a block, (B, 2): negative log predictive density summed over the joints, nats; and
    squared error / variance of the torque averaged over the joints with varying torque, NaN if there are none."""

    @classmethod
    def of(cls, samples: Samples, answer: TorqueDistribution) -> BlockScores:
        """Return the scores of a prediction of samples (N, n)."""
        starts, tau = blocks(samples), samples.tau
        varies = np.ptp(tau, axis=0) > 0
        squared = (tau - answer.mean)[:, varies] ** 2 / tau[:, varies].var(axis=0)
        nmse = squared.mean(axis=1) if varies.any() else np.full(len(tau), np.nan)
        values = np.stack([compute_nlpd(tau, answer).sum(axis=1), nmse], axis=1)
        return cls(np.diff(starts, append=len(tau)), np.add.reduceat(values, starts, axis=0))

    def difference_from(self, first: BlockScores) -> Difference:
        """Return the mean difference of these scores from those of `first` on the same blocks, a row, (2,)."""
        return average_blocks(self.rows, self.sums - first.sums)


def compare(samples: Samples, first: TorqueDistribution, second: TorqueDistribution) -> Comparison:
    """Return the metrics of the second prediction of samples (N, n) minus those of the first."""
    starts, tau = blocks(samples), samples.tau
    (squared, inside, density), (others, insides, densities) = (_figures(tau, each) for each in (first, second))
    # rounding gives a constant column a variance above zero
    variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), np.nan)
    normalised = (others - squared) / variance
    rms = np.sqrt(squared.mean(axis=0)) + np.sqrt(others.mean(axis=0))
    return Comparison(
        nmse=average_differences(normalised, starts),
        # a² - b² = (a - b)(a + b)
        rmse=average_differences(np.divide(others - squared, rms, out=np.zeros_like(squared), where=rms > 0), starts),
        coverage=average_differences(insides - inside, starts),
        nlpd=average_differences(densities - density, starts),
        total=BlockScores.of(samples, second).difference_from(BlockScores.of(samples, first)),
        blocks=len(starts),
    )


def compute_nlpd(tau: Array, answer: TorqueDistribution) -> Array:
    """Return the negative log predictive density of torques (N, n), nats, noise included: (N, n)."""
    return negative_log_density(tau - answer.mean, answer.spread)


def _figures(tau: Array, answer: TorqueDistribution) -> tuple[Array, Array, Array]:
    """Return squared error, whether the interval contains the measurement, and negative log density, (N, n) each."""
    return (tau - answer.mean) ** 2, answer.contains(tau).astype(np.float64), compute_nlpd(tau, answer)


def blocks(samples: Samples) -> NDArray[np.int64]:
    """Return the first row of each block, rising, at most 64: if there are more, neighbouring blocks are merged."""
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


def average_differences(values: Array, starts: NDArray[np.int64]) -> Difference:
    """Return the mean of paired differences (N, k) in B blocks that begin at the rows `starts` (B,)."""
    return average_blocks(np.diff(starts, append=len(values)), np.add.reduceat(values, starts, axis=0))


def average_blocks(rows: NDArray[np.int64], sums: Array) -> Difference:
    """Return the mean of paired differences in B >= 1 consecutive blocks from their rows (B,) and sums (B, k).

    With S_b the sums and N_b the rows of the blocks, N = Σ N_b, d_b = S_b - N_b mean and ρ the correlation of
    neighbouring d_b, corrected for its bias in B blocks and limited to 0 to 0.9:
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
