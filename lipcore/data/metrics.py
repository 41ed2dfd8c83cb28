"""How good a torque model is, per joint, against held-out measurements."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lipcore.data.samples import Array

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


def evaluate(tau: Array, mean: Array, std: Array, noise_std: Array, level: float = 0.95) -> Metrics:
    """Compare measured torques (N, n) with predicted mean, function std (N, n) and noise std (n,) or (N, n).

    nmse is NaN for a joint whose measured torque does not vary. Raise ValueError where shapes differ.
    """
    if mean.shape != tau.shape or std.shape != tau.shape:
        raise ValueError(f"mean has shape {mean.shape} and std {std.shape}, expected {tau.shape} as tau has")
    error = tau - mean
    total = np.sqrt(std**2 + noise_std**2)
    squared = np.mean(error**2, axis=0)
    # rounding gives a constant column a variance above zero
    variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), 0.0)
    return Metrics(
        nmse=np.divide(squared, variance, out=np.full_like(squared, np.nan), where=variance > 0),
        rmse=np.sqrt(squared),
        coverage=_coverage(error, total, level),
        nlpd=np.mean(negative_log_density(error, total), axis=0),
        width=_width(total, level),
        level=level,
        coverages=np.array([_coverage(error, total, each) for each in LEVELS]),
        widths=np.array([_width(total, each) for each in LEVELS]),
        reliability=np.array([_coverage(error, total, each) for each in RELIABILITY_LEVELS]),
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
