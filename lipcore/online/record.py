"""Sum up how well torques were predicted before they were learnt: the prequential record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from lipcore.data.metrics import negative_log_density, quantile

if TYPE_CHECKING:
    from lipcore.data.samples import Array

LEVEL = 0.95
"""Probability of the interval that `inside` refers to."""
HALF_WIDTH = quantile(LEVEL)
MEAN_FIELDS = ("error", "squared", "inside", "nlpd", "standardised", "variance", "noise")
"""Plain means over the rows. `mean` and `spread` are merged together, by Chan's formula."""
MIN_FLOOR_ROWS = 50
"""Fewer rows raise no floor: noise alone changes the mean of 49 squares by a fifth."""
MIN_FLOOR_STDS = 3.0
"""Min standard errors of an excess that is not chance."""


@dataclass(frozen=True, eq=False)
class Record:
    """Quality of predictions made before `rows` rows were learnt, per joint (n,).

    e = tau − mean, s² = std² + noise_std².

    Records add: `a + b` is the record of the rows of both, associative and commutative up to rounding. Means are stored
    instead of sums, and spread is merged by Chan's formula, so that a large constant torque does not cancel digits.
    """

    rows: int
    error: Array
    """Mean of e, N·m."""
    squared: Array
    """Mean of e²."""
    mean: Array
    """Mean of tau."""
    spread: Array
    """Mean squared deviation of tau from its mean."""
    inside: Array
    """Share of |e| within the 95 % interval ±1.96 s."""
    nlpd: Array
    """Mean of ½ log(2π s²) + ½ e²/s², nats."""
    standardised: Array
    """Mean of e²/s²."""
    variance: Array
    """Mean of std², of the function alone."""
    noise: Array
    """Mean of noise_std²."""

    @staticmethod
    def empty(n: int) -> Record:
        """Return the record of no rows of n joints, the neutral element of addition."""
        return Record(0, *(np.zeros(n) for _ in range(len(fields(Record)) - 1)))

    @staticmethod
    def of(tau: Array, mean: Array, std: Array, noise_std: Array, scale: Array | float = 1.0) -> Record:
        """Return the record of torques tau (N, n) with predictions mean, std (N, n), and noise_std (n,) or (N, n).

        scale: (n,), factor on the half width of the intervals for `inside`. Raise ValueError if shapes differ, a value
        is not finite, or an interval has no width: one such row would spoil every sum.
        """
        total = _deviation(tau, mean, std, noise_std)
        if len(tau) == 0:
            return Record.empty(tau.shape[1])
        error = tau - mean
        ratio = (error / total) ** 2
        # rounding can shift the mean of equal numbers, and a constant torque would get a spread
        centre = np.where(np.ptp(tau, axis=0) > 0, tau.mean(axis=0), tau[0])
        return Record(
            rows=len(tau),
            error=error.mean(axis=0),
            squared=(error**2).mean(axis=0),
            mean=centre,
            spread=((tau - centre) ** 2).mean(axis=0),
            inside=(np.abs(error) <= HALF_WIDTH * scale * total).mean(axis=0),
            nlpd=negative_log_density(error, total).mean(axis=0),
            standardised=ratio.mean(axis=0),
            variance=(std**2).mean(axis=0),
            noise=np.broadcast_to(noise_std**2, tau.shape).mean(axis=0),
        )

    def __add__(self, other: Record) -> Record:
        """Return the record of the rows of both; raise ValueError if their joints differ."""
        if self.n_joints != other.n_joints:
            raise ValueError(f"records of {self.n_joints} and {other.n_joints} joints do not add")
        if not other.rows:
            return self
        if not self.rows:
            return other
        rows = self.rows + other.rows
        share = other.rows / rows
        means = {name: _between(getattr(self, name), getattr(other, name), share) for name in MEAN_FIELDS}
        apart = share * (1 - share) * (other.mean - self.mean) ** 2
        return Record(
            rows=rows,
            mean=_between(self.mean, other.mean, share),
            spread=_between(self.spread, other.spread, share) + apart,
            **means,
        )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.error)

    @property
    def rmse(self) -> Array:
        """Return the root mean squared error, N·m: (n,), NaN without rows."""
        return np.sqrt(self._known(self.squared))

    @property
    def nmse(self) -> Array:
        """Return the mean squared error / variance of the torque: (n,), NaN if the torque did not vary."""
        out = np.full(self.n_joints, np.nan)
        return np.asarray(np.divide(self.squared, self.spread, out=out, where=self.spread > 0))

    @property
    def coverage(self) -> Array:
        """Return the share of measurements inside the 95 % interval, noise included: (n,), NaN without rows."""
        return self._known(self.inside)

    def metrics(self) -> dict[str, list[float | None]]:
        """Return nmse, rmse, coverage, nlpd and standardised error, one number per joint, for JSON: None if unknown."""
        figures = {
            "nmse": self.nmse,
            "rmse": self.rmse,
            "coverage": self.coverage,
            "nlpd": self._known(self.nlpd),
            "standardised": self._known(self.standardised),
        }
        return {name: [number(value) for value in values] for name, values in figures.items()}

    def to_json(self) -> dict[str, Any]:
        """Return all fields as numbers and lists; `from_json` restores them to the last bit."""
        return {"rows": self.rows} | {name: getattr(self, name).tolist() for name in _names()}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Record:
        """Read what `to_json` returned; raise ValueError if a field is missing or is no list of n finite numbers."""
        if missing := [name for name in ("rows", *_names()) if name not in values]:
            raise ValueError(f"record lacks {', '.join(missing)}")
        rows = values["rows"]
        if not isinstance(rows, int) or isinstance(rows, bool) or rows < 0:
            raise ValueError(f"record has rows {rows!r}, expected an integer of at least 0")
        arrays = {name: np.asarray(values[name], dtype=np.float64) for name in _names()}
        joints = arrays["error"].shape
        for name, array in arrays.items():
            if array.ndim != 1 or array.shape != joints or not np.isfinite(array).all():
                raise ValueError(f"record has {name} {values[name]!r}, expected one finite number a joint")
        return Record(rows=rows, **arrays)

    def _known(self, values: Array) -> Array:
        return values if self.rows else np.full(self.n_joints, np.nan)


def number(value: float) -> float | None:
    """Return `value` for JSON, which has no NaN: None instead."""
    return float(value) if np.isfinite(value) else None


def _names() -> list[str]:
    return [f.name for f in fields(Record) if f.name != "rows"]


def _between(a: Array, b: Array, share: float) -> Array:
    """Return the mean of both if b has `share` of the rows; exactly a if they are equal."""
    return np.asarray(a + share * (b - a))


def _deviation(tau: Array, mean: Array, std: Array, noise_std: Array) -> Array:
    """Return the standard deviation of a measurement, (N, n); raise ValueError for invalid arrays."""
    if tau.ndim != 2:
        raise ValueError(f"tau has shape {tau.shape}, expected (N, n)")
    for name, array in (("mean", mean), ("std", std)):
        if array.shape != tau.shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {tau.shape}, the shape of tau")
    if noise_std.shape not in (tau.shape, tau.shape[1:]):
        raise ValueError(f"noise_std has shape {noise_std.shape}, expected {tau.shape[1:]} or {tau.shape}")
    for name, array in (("tau", tau), ("mean", mean), ("std", std), ("noise_std", noise_std)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    total = np.sqrt(std**2 + noise_std**2)
    if not (total > 0).all():
        raise ValueError("std and noise_std are both 0, expected at least one of them above 0")
    return np.asarray(total)


def error_floor(record: Record) -> Array:
    """Return the function variance (N·m)², (n,), that the errors of `record` prove: mean e² − noise variance, or 0.

    If the function is right, e is noise: e²/noise has mean 1 and variance 2 (Gaussian), so its mean over N rows has the
    standard error √(2/N). An excess of more than three of them, mean e² > noise (1 + 3 √(2/N)), counts in full. White
    noise alone raises a floor in 0.3 % (N = 50) to 0.15 % (N = 2000) of the records of one joint, and a small one:
    about noise · 3 √(2/N). Fewer than 50 rows: 0.
    """
    if record.rows < MIN_FLOOR_ROWS:
        return np.zeros(record.n_joints)
    chance = record.noise * (1 + MIN_FLOOR_STDS * np.sqrt(2 / record.rows))
    return np.where(record.squared > chance, record.squared - record.noise, 0.0)
