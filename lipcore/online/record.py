"""How well torques were predicted before they were learnt from, in sums that add up: the prequential record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from lipcore.data.metrics import negative_log_density, quantile

if TYPE_CHECKING:
    from lipcore.data.samples import Array

LEVEL = 0.95
"""Probability of the interval that `inside` counts."""
HALF_WIDTH = quantile(LEVEL)
FIGURES = ("error", "squared", "inside", "nlpd", "standardised", "variance", "noise")
"""Plain means over the rows; `mean` and `spread` belong together and merge by Chan's formula."""
FEWEST_ROWS = 50
"""Fewer rows say too little: noise alone moves the mean of 49 squares by a fifth."""
DEVIATIONS = 3.0
"""Standard errors beyond which an excess is not chance."""


@dataclass(frozen=True, eq=False)
class Record:
    """What `rows` rows say about predictions made before they were learnt, per joint (n,).

    With e = tau − mean and s² = std² + noise_std²: `error` the mean of e, `squared` of e², `standardised` of e²/s²,
    `nlpd` of ½ log(2π s²) + ½ e²/s² (nats), `variance` of std² (of the function alone), `noise` of noise_std²; `inside`
    the share of |e| within the 95 % interval ±1.96 s; `mean`, `spread` mean and mean squared deviation of tau itself.

    Records add: `a + b` is the record of the rows of both, associative and commutative up to rounding. Means are kept
    and not sums, and spread is merged by Chan's formula, so that the weight of an arm does not cancel.
    """

    rows: int
    error: Array
    squared: Array
    mean: Array
    spread: Array
    inside: Array
    nlpd: Array
    standardised: Array
    variance: Array
    noise: Array

    @staticmethod
    def empty(n: int) -> Record:
        """The record of no rows of n joints: what adds nothing."""
        return Record(0, *(np.zeros(n) for _ in range(len(fields(Record)) - 1)))

    @staticmethod
    def of(tau: Array, mean: Array, std: Array, noise_std: Array, scale: Array | float = 1.0) -> Record:
        """Record of measured torques tau (N, n) against mean and function std (N, n) and noise std (n,) or (N, n).

        scale: (n,), factor on the half width of the intervals that hold what is `inside`. Raise ValueError where shapes
        differ, a value is not finite, or an interval has no width: one such row would spoil every sum that it enters.
        """
        total = _deviation(tau, mean, std, noise_std)
        if len(tau) == 0:
            return Record.empty(tau.shape[1])
        error = tau - mean
        ratio = (error / total) ** 2
        # the rounded mean of equal numbers is not always that number, which would give a constant torque a spread
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
        """Record of the rows of both; raise ValueError where they have different joints."""
        if self.n_joints != other.n_joints:
            raise ValueError(f"records of {self.n_joints} and {other.n_joints} joints do not add")
        if not other.rows:
            return self
        if not self.rows:
            return other
        rows = self.rows + other.rows
        share = other.rows / rows
        means = {name: _between(getattr(self, name), getattr(other, name), share) for name in FIGURES}
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
        """Root of the mean squared error, N·m: (n,), NaN without rows."""
        return np.sqrt(self._known(self.squared))

    @property
    def nmse(self) -> Array:
        """Mean squared error / variance of the torque: (n,), NaN where the torque did not vary."""
        out = np.full(self.n_joints, np.nan)
        return np.asarray(np.divide(self.squared, self.spread, out=out, where=self.spread > 0))

    @property
    def coverage(self) -> Array:
        """Share of measurements inside the 95 % interval, noise included: (n,), NaN without rows."""
        return self._known(self.inside)

    def metrics(self) -> dict[str, list[float | None]]:
        """nmse, rmse, coverage, nlpd and standardised error, one number a joint, for JSON: None where not known."""
        figures = {
            "nmse": self.nmse,
            "rmse": self.rmse,
            "coverage": self.coverage,
            "nlpd": self._known(self.nlpd),
            "standardised": self._known(self.standardised),
        }
        return {name: [number(value) for value in values] for name, values in figures.items()}

    def to_json(self) -> dict[str, Any]:
        """All fields as numbers and lists; `from_json` gives back the same record to the last bit."""
        return {"rows": self.rows} | {name: getattr(self, name).tolist() for name in _names()}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Record:
        """Record that `to_json` wrote; raise ValueError where a field is missing or is no list of n finite numbers."""
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
    """`value` for JSON, which has no NaN: None in its place."""
    return float(value) if np.isfinite(value) else None


def _names() -> list[str]:
    return [f.name for f in fields(Record) if f.name != "rows"]


def _between(a: Array, b: Array, share: float) -> Array:
    """Mean of both where b has `share` of the rows; exactly a where they are equal."""
    return np.asarray(a + share * (b - a))


def _deviation(tau: Array, mean: Array, std: Array, noise_std: Array) -> Array:
    """Standard deviation of a measurement, (N, n); raise ValueError for arrays that no record can be made of."""
    if tau.ndim != 2:
        raise ValueError(f"tau has shape {tau.shape}, expected (N, n)")
    for name, array in (("mean", mean), ("std", std)):
        if array.shape != tau.shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {tau.shape} as tau has")
    if noise_std.shape not in (tau.shape, tau.shape[1:]):
        raise ValueError(f"noise_std has shape {noise_std.shape}, expected {tau.shape[1:]} or {tau.shape}")
    for name, array in (("tau", tau), ("mean", mean), ("std", std), ("noise_std", noise_std)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    total = np.sqrt(std**2 + noise_std**2)
    if not (total > 0).all():
        raise ValueError("std and noise_std are both 0, expected an interval of some width")
    return np.asarray(total)


def error_floor(record: Record) -> Array:
    """Function variance (N·m)², (n,), that the errors of `record` prove: mean e² − noise variance, or 0.

    Where the function is right, e is noise: e²/noise has mean 1 and variance 2 (Gaussian), so its mean over N rows has
    the standard error √(2/N). The excess is reported beyond three of them, mean e² > noise (1 + 3 √(2/N)), and taken
    whole then. White noise alone raises a floor in 0.3 % (N = 50) to 0.15 % (N = 2000) of the records of one joint, and
    a small one: about noise · 3 √(2/N). Fewer than 50 rows: 0.
    """
    if record.rows < FEWEST_ROWS:
        return np.zeros(record.n_joints)
    chance = record.noise * (1 + DEVIATIONS * np.sqrt(2 / record.rows))
    return np.where(record.squared > chance, record.squared - record.noise, 0.0)
