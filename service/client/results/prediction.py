"""Torques with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from service.client.results.arrays import Array, Plain, reading


def interval(mean: Array, std: Array, noise_std: Array, level: float) -> tuple[Array, Array]:
    """Ends of the central interval that a measurement lies in with probability `level`; std: of the function, noise_std
    of a measurement around it. Raise ValueError unless level is between 0 and 1."""
    if not 0 < level < 1:
        raise ValueError(f"level is {level}, expected a probability between 0 and 1")
    half = NormalDist().inv_cdf((1 + level) / 2) * np.hypot(std, noise_std)
    return mean - half, mean + half


@dataclass(frozen=True, eq=False)
class Component(Plain):
    """A part of the dynamics at one query or a batch: numbers () or (N), vectors (…, n) or matrices (…, n, n).

    mean; std: standard deviation of the function, of forward dynamics to first order.
    """

    mean: Array
    std: Array


@dataclass(frozen=True, eq=False)
class Prediction(Plain):
    """Torques at one query, (n), or a batch, (N, n); N·m, of prismatic joints N.

    revision: online updates applied to the version; tau: mean; tau_std: standard deviation of the function, which grows
    where the model knows little; noise_std: (n) of a measurement around the function; covariance: (…, n, n) (N·m)² of
    the function between joints, where asked for; components: by name, where asked for.
    """

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    tau: Array
    tau_std: Array
    noise_std: Array
    covariance: Array | None = None
    components: Mapping[str, Component] | None = None

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper end, shaped as `tau`, of the central interval that a *measurement* lies in with probability
        `level`: uncertainty of the function and noise of the measurement together. That of the function alone is
        narrower, and does not hold measurements.
        """
        return interval(self.tau, self.tau_std, self.noise_std, level)


read_prediction = reading(Prediction)
