"""Intervals that hold what they promise whatever the robot does: a factor on their width that measurements move."""

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
    """How fast a scale s follows measurements, and how far.

    `rate`, `share`, `min_rows` and `margin` were tuned with benchmarks/studies/adaptive_intervals.py on its streams for
    tuning, so that every minute holds 93 to 97 % and each joint at least 85 % from 0.3 s after a payload on, and for
    the min width then.
    """

    rate: float = 10.0
    """What a second of misses moves log s by; if everything lies inside, it falls by 0.5 a second. With 5 some minutes
    held 98 %."""
    share: float = 0.7
    min_rows: int = 5
    """If this share of so many rows or more lies outside, the scale leaps to what would have held the batch."""
    margin: float = 1.5
    """Factor on the max error of such a batch: those of a new payload go on growing with the motion."""
    max_step: float = 0.25
    """Max change of log s by one batch, unless its errors say more: a batch may bring many seconds of rows."""
    max_owed: float = 30.0
    """A minute in which everything lies inside pays as much."""
    max_gain: float = 0.5
    """Max change of log s by one row, however long ago the row before it was."""
    max_gap_s: float = 1.0
    """A longer time between two batches is a pause, in which nothing was observed."""
    usual_step_s: float = 0.01
    """Time between rows that have no times."""
    min_scale: float = 0.1
    max_scale: float = 1e4
    """A small scale is no danger to the stream that has earned it, whose next misses leap; see `widest`."""


OPTIONS = AdaptiveOptions()


@dataclass(frozen=True, eq=False)
class Adaptive:
    """The scale s of a stream's intervals, mean ± s · 1.96 · √(std² + noise_std²), joint by joint; immutable.

    Quantile tracking (adaptive conformal inference, Gibbs & Candès 2021, with a step for log s): rows that stand for dt
    seconds each move log s by rate · dt · (miss − 0.05), where `miss` says whether one lay outside the interval that it
    was answered with. So, whatever the errors are, over a stretch of T seconds

        |share of misses − 0.05| ≤ (|change of log s| + |change of owed| + leaps) / (rate · T)

    with the leaps that are added: a scale that grows tenfold shifts the coverage of that minute by 0.4 to 0.8 %. What
    the misses of a long batch ask for beyond the errors in it is not paid by a larger scale but `owed`: the scale does
    not fall before that is paid. It holds for rows that are evenly spaced, within the min and max scale.

    log: (n,), of s; owed: (n,), in the same unit; last: event time of the latest row, s.
    """

    log: Array
    owed: Array
    last: float | None = None

    @staticmethod
    def start(factor: Array) -> Adaptive:
        """Before the first row: the version's own factors s, (n,)."""
        return Adaptive(np.log(factor), np.zeros(len(factor)))

    @property
    def factor(self) -> Array:
        """s, (n,)."""
        return np.asarray(np.exp(self.log))

    def step(self, time: Array, score: Array, answered: Array | None = None) -> Adaptive:
        """Follow the rows of a batch at event times (N,), s, with their scores (N, n), see `scores`.

        answered: the factors that they were answered with, (N, n) or (n,); that from before the batch where None.
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
        return Adaptive(np.clip(log, np.log(OPTIONS.min_scale), np.log(OPTIONS.max_scale)), owed, last)

    def to_json(self) -> dict[str, Any]:
        """Its state as numbers and lists; `from_json` gives back the same to the last bit."""
        return {"log": self.log.tolist(), "owed": self.owed.tolist(), "last": self.last}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Adaptive:
        """What `to_json` wrote."""
        log, owed = (np.array(values[name], np.float64) for name in ("log", "owed"))
        return Adaptive(log, owed, values["last"])

    def _spacing(self, time: Array) -> float:
        """Seconds that each of these rows stands for."""
        first, latest = float(time.min()), float(time.max())
        if self.last is not None and first - OPTIONS.max_gap_s <= self.last < latest:
            first = self.last
        return (latest - first) / len(time) or OPTIONS.usual_step_s


def scores(error: Array, std: Array, noise_std: Array) -> Array:
    """|error| over the half width that the model believes, (N, n): an interval of scale s holds scores of up to s.

    error = tau − mean and std, the function's deviation, (N, n); noise_std (n,), N·m.
    """
    return np.asarray(np.abs(error) / (HALF_WIDTH * np.sqrt(std**2 + noise_std**2)))


def outside(score: Array, factor: Array) -> NDArray[np.bool_]:
    """Which measurements of these scores, (N, n), lie outside intervals of these scales, (N, n) or (n,)."""
    return np.asarray(score > factor)


def widest(factors: Sequence[Array], own: Array) -> Array:
    """The largest of several streams' scales and the version's own, (n,), for a question that belongs to no stream.

    Not below its own: a smaller one is earned by the motion of the moment, and the question may be of another.
    """
    return np.asarray(np.maximum.reduce([own, *factors]))
