"""Scale the intervals of a stream so that their coverage stays at 95 % whatever the robot does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.record import HALF_WIDTH, LEVEL


@dataclass(frozen=True)
class AdaptiveOptions:
    """How fast and how far a scale s follows measurements.

    `rate`, `share`, `min_rows` and `margin` were tuned with benchmarks/studies/adaptive_intervals.py on its tuning
    streams. Goals: a coverage of 93 to 97 % in every minute and of at least 85 % per joint from 0.3 s after a payload,
    at the min width.
    """

    rate: float = 10.0
    """Growth of log s per second outside the interval; per second inside, log s falls by 0.5. With 5, the coverage of
    some minutes was 98 %."""
    share: float = 0.7
    min_rows: int = 5
    """If a batch has at least `min_rows` rows and at least this share lies outside, the scale jumps to a value that
    contains the batch."""
    margin: float = 1.5
    """Factor on the max error of such a batch: the errors of a new payload continue to grow with the motion."""
    max_step: float = 0.25
    """Max change of log s by one batch, unless its errors require more: a batch may contain many seconds of rows."""
    max_owed: float = 30.0
    """A minute with all measurements inside reduces `owed` by as much."""
    max_gain: float = 0.5
    """Max change of log s by one row, however long ago the previous row was."""
    max_gap_s: float = 1.0
    """A longer time between two batches is a pause without measurements."""
    usual_step_s: float = 0.01
    """Time between rows without times."""
    min_scale: float = 0.1
    max_scale: float = 1e4
    """A small scale is safe for its own stream: its next misses raise it at once; for other queries see `widest`."""


OPTIONS = AdaptiveOptions()


@dataclass(frozen=True, eq=False)
class AdaptiveScale:
    """The scale s of a stream's intervals, mean ± s · 1.96 · √(std² + noise_std²), per joint; immutable.

    Quantile tracking (adaptive conformal inference, Gibbs & Candès 2021, with a step for log s). Each row that
    represents dt seconds changes log s by rate · dt · (miss − 0.05); miss is 1 if the row lay outside its returned
    interval, else 0. Whatever the errors are, over T seconds

        |share of misses − 0.05| ≤ (|change of log s| + |change of owed| + jumps) / (rate · T)

    A scale that grows tenfold shifts the coverage of that minute by 0.4 to 0.8 %. If the misses of a long batch require
    more growth than its errors, the rest does not enlarge the scale but is `owed`: the scale does not fall until that
    is paid. The bound holds for evenly spaced rows, between the min and the max scale.
    """

    log: Array
    """log s, (n,)."""
    owed: Array
    """Growth of log s that is still owed, (n,)."""
    last: float | None = None
    """Event time of the latest row, s."""

    @staticmethod
    def start(factor: Array) -> AdaptiveScale:
        """Return the scale before the first row. factor: the version's own s, (n,)."""
        return AdaptiveScale(np.log(factor), np.zeros(len(factor)))

    @property
    def factor(self) -> Array:
        """Return s, (n,)."""
        return np.asarray(np.exp(self.log))

    def step(self, time: Array, score: Array, answered: Array | None = None) -> AdaptiveScale:
        """Return the scale after the rows of a batch. time: (N,) s; score: (N, n), see `scores`.

        answered: the factors of the returned intervals, (N, n) or (n,); None: the factor before the batch.
        """
        if not len(score):
            return self
        missed = outside(score, self.factor if answered is None else answered)
        moved = min(OPTIONS.rate * self._spacing(time), OPTIONS.max_gain) * (missed - (1 - LEVEL)).sum(axis=0)
        size = np.log(np.maximum(score, OPTIONS.min_scale))
        leap = size.max(axis=0) + np.log(OPTIONS.margin) - self.log
        sudden = (missed.mean(axis=0) >= OPTIONS.share) & (len(score) >= OPTIONS.min_rows)
        moved = np.where(sudden, np.maximum(moved, leap), moved)
        most = np.maximum(leap, OPTIONS.max_step)
        paid = np.minimum(self.owed, np.maximum(-moved, 0.0))
        owed = np.minimum(self.owed - paid + np.maximum(moved - most, 0.0), OPTIONS.max_owed)
        place = int(np.ceil(LEVEL * len(size))) - 1
        least = np.minimum(np.partition(size, place, axis=0)[place] - self.log, -OPTIONS.max_step)
        log = self.log + np.clip(moved + paid, least, most)
        latest = float(time.max())
        last = latest if self.last is None else max(latest, self.last)
        return AdaptiveScale(np.clip(log, np.log(OPTIONS.min_scale), np.log(OPTIONS.max_scale)), owed, last)

    def to_json(self) -> dict[str, Any]:
        """Return the state as numbers and lists; `from_json` restores it to the last bit."""
        return {"log": self.log.tolist(), "owed": self.owed.tolist(), "last": self.last}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> AdaptiveScale:
        """Read what `to_json` returned."""
        log, owed = (np.array(values[name], np.float64) for name in ("log", "owed"))
        return AdaptiveScale(log, owed, values["last"])

    def _spacing(self, time: Array) -> float:
        """Return the seconds that each row represents."""
        first, latest = float(time.min()), float(time.max())
        if self.last is not None and first - OPTIONS.max_gap_s <= self.last < latest:
            first = self.last
        return (latest - first) / len(time) or OPTIONS.usual_step_s


def scores(error: Array, std: Array, noise_std: Array) -> Array:
    """Return |error| over the unscaled interval's half width, (N, n); an interval of scale s contains scores up to s.

    error = tau − mean and std, the function's standard deviation, (N, n); noise_std: (n,), N·m.
    """
    return np.asarray(np.abs(error) / (HALF_WIDTH * np.sqrt(std**2 + noise_std**2)))


def outside(score: Array, factor: Array) -> NDArray[np.bool_]:
    """Return which scores, (N, n), lie outside intervals of these scales, (N, n) or (n,)."""
    return np.asarray(score > factor)


def widest(factors: Sequence[Array], own: Array) -> Array:
    """Return the max of several streams' scales and the version's own, (n,), for a query without a stream.

    It is never below the version's own scale: a smaller one results from a stream's current motion, and the query may
    be about another.
    """
    return np.asarray(np.maximum.reduce([own, *factors]))
