"""How good a torque model is, per joint, against held-out measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from lipcore.samples import Array


@dataclass(frozen=True)
class Metrics:
    """Per-joint figures, each (n,).

    nmse: mean squared error / variance of the measured torque; rmse: N·m; coverage: share of measurements inside the
    `level` interval, noise included; nlpd: mean negative log predictive density, nats; width: mean width of that
    interval, N·m.
    """

    nmse: Array
    rmse: Array
    coverage: Array
    nlpd: Array
    width: Array
    level: float


def evaluate(tau: Array, mean: Array, std: Array, noise_std: Array, level: float = 0.95) -> Metrics:
    """Compare measured torques (N, n) with predicted mean, function std (N, n) and noise std (n,) or (N, n).

    nmse is NaN for a joint whose measured torque does not vary. Raise ValueError where shapes differ.
    """
    if mean.shape != tau.shape or std.shape != tau.shape:
        raise ValueError(f"mean has shape {mean.shape} and std {std.shape}, expected {tau.shape} as tau has")
    error = tau - mean
    total = np.sqrt(std**2 + noise_std**2)
    half = float(norm.ppf(0.5 + level / 2)) * total
    squared = np.mean(error**2, axis=0)
    # rounding gives a constant column a variance above zero
    variance = np.where(np.ptp(tau, axis=0) > 0, tau.var(axis=0), 0.0)
    return Metrics(
        nmse=np.divide(squared, variance, out=np.full_like(squared, np.nan), where=variance > 0),
        rmse=np.sqrt(squared),
        coverage=np.mean(np.abs(error) <= half, axis=0),
        nlpd=np.mean(0.5 * np.log(2 * np.pi * total**2) + 0.5 * (error / total) ** 2, axis=0),
        width=np.mean(2 * half, axis=0),
        level=level,
    )
