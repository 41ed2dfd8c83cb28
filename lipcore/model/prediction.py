"""Predicted torques with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from lipcore.data.metrics import TorqueDistribution
from lipcore.data.samples import Array


@dataclass(frozen=True)
class Fallback:
    """Difference of torques from the posterior mean, if the training does not determine them.

    Both arrays have the shape of the torques.
    """

    share: Array
    """Share of the fallback in each torque, 0 to 1."""
    mean: Array
    """Posterior mean, N·m."""


class TorqueAnswer(NamedTuple):
    """Prediction for one query of n joints, N·m: see `TorquePrediction`. tau, tau_std: (n,); covariance: (n, n)."""

    tau: Array
    tau_std: Array | None
    covariance: Array | None
    fallback: Fallback | None

    @property
    def mean(self) -> Array:
        """Posterior mean, (n,): equals `tau` unless it falls back."""
        return self.tau if self.fallback is None else self.fallback.mean


@dataclass(frozen=True)
class TorquePrediction:
    """Prediction for N queries of n joints, N·m.

    The 95 % intervals of measurements are

        tau ± 1.96 · scale · √(tau_std² + noise_std²)

    Standard deviations and covariances are always those of the posterior.
    """

    tau: Array
    """Torque, (N, n)."""
    tau_std: Array
    """Standard deviation of the function, (N, n)."""
    noise_std: Array
    """Standard deviation of the measurement noise, (n,)."""
    scale: Array
    """Factor on the half width of intervals, (n,)."""
    covariance: Array | None = None
    """Covariance of the function between joints, (N, n, n), if requested."""
    fallback: Fallback | None = None
    """Fallback, or None if every torque is the posterior mean."""

    @property
    def mean(self) -> Array:
        """Posterior mean, (N, n): equals `tau` unless it falls back."""
        return self.tau if self.fallback is None else self.fallback.mean

    @property
    def interval(self) -> TorqueDistribution:
        """Parts of the intervals, for `lipcore.data.metrics.evaluate(tau, *prediction.interval)`."""
        return TorqueDistribution(self.tau, self.tau_std, self.noise_std, self.scale)
