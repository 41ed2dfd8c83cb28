"""Torques with their uncertainty: of queries, of recordings beside what was measured, and as a model is told them; and
recordings thinned for a plot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from lipserve.call import Answer, record
from lipserve.records.live import LiveLost, LiveStatus
from lipserve.results import Array, Plain, reading, shape_arrays


def interval(
    mean: Array, std: Array, noise_std: Array, level: float, scale: Array | None = None
) -> tuple[Array, Array]:
    """Ends of the central interval that a measurement lies in with probability `level`; std: of the function, noise_std
    of a measurement around it, scale: (n) factor on its half. Raise ValueError unless level is between 0 and 1."""
    if not 0 < level < 1:
        raise ValueError(f"level is {level}, expected a probability between 0 and 1")
    half = NormalDist().inv_cdf((1 + level) / 2) * np.hypot(std, noise_std)
    half = half if scale is None else half * scale
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
    where the model knows little; noise_std: (n) of a measurement around the function; scale: (n) factor on the half
    width of intervals that streams need at the moment, None of an earlier service; guaranteed: (n) share of
    measurements that left-out blocks of the training guarantee for intervals of 95 %, None of the shipped model;
    covariance: (…, n, n) (N·m)² of the function between joints, where asked for; components: by name, where asked for;
    fallback: share of the fallback in each torque, shaped as `tau`, None if all are zero. Where it is 1, `tau` is
    gravity, offset and friction only, or the training's mean: the training does not determine the torque there.
    """

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    tau: Array
    tau_std: Array
    noise_std: Array
    scale: Array | None = None
    guaranteed: Array | None = None
    covariance: Array | None = None
    components: Mapping[str, Component] | None = None
    fallback: Array | None = None

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper end, shaped as `tau`, of the central interval that a *measurement* lies in with probability
        `level`: uncertainty of the function and noise of the measurement together, times `scale`. That of the function
        alone is narrower, and does not hold measurements.
        """
        return interval(self.tau, self.tau_std, self.noise_std, level, self.scale)


read_prediction = reading(Prediction)


@dataclass(frozen=True, eq=False)
class PreviewColumn(Plain):
    """Points (K) of one quantity of one joint: rows, counted from 0; t: their times, s; values in `unit`."""

    quantity: str
    joint: str
    unit: str
    rows: NDArray[np.int64]
    t: Array
    values: Array


@dataclass(frozen=True, eq=False)
class Preview(Plain):
    """Columns of a data set, thinned so that no extreme is lost. samples: rows of the data set; starts: first rows of
    its episodes."""

    samples: int
    starts: NDArray[np.int64]
    columns: tuple[PreviewColumn, ...]

    def column(self, quantity: str, joint: str) -> PreviewColumn:
        """One column; raise KeyError."""
        for each in self.columns:
            if (each.quantity, each.joint) == (quantity, joint):
                return each
        raise KeyError(f"no column of {quantity} of {joint}")


read_preview = reading(Preview)


@dataclass(frozen=True, eq=False)
class Trace(Plain):
    """Torques (K, n) at K rows of a data set, N·m (prismatic: N).

    samples: of the data set or the part; in_range: of these between start and stop; shown: K, evenly chosen where there
    are more, so that peaks may be missing; rows: (K) counted from 0; t: (K) s; breaks: places in `rows` that lines are
    not to be drawn across; tau: measured; mean: predicted; std: (K, n) of the function; noise_std: (n) of a
    measurement; scale: (n) factor on the half width of intervals, None of an earlier service; offered: components that
    may be asked for; components: by name, where asked for; in_training: whether the model was trained on these samples:
    then it looks better than it is.
    """

    model: str
    version: int
    revision: int
    dataset: str
    part: str
    joint_names: tuple[str, ...]
    torque_convention: str
    samples: int
    in_range: int
    shown: int
    rows: NDArray[np.int64]
    t: Array
    breaks: NDArray[np.int64]
    tau: Array
    mean: Array
    std: Array
    noise_std: Array
    offered: tuple[str, ...]
    components: Mapping[str, Component]
    in_training: bool
    scale: Array | None = None

    def __post_init__(self) -> None:
        shape = (len(self.rows), len(self.joint_names))
        for each in (self, *self.components.values()):
            shape_arrays(each, shape, *({"tau", "mean", "std"} & vars(each).keys()))

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper end (K, n) of the interval that shall hold a share `level` of the *measurements*."""
        return interval(self.mean, self.std, self.noise_std, level, self.scale)


read_trace = reading(Trace)


@dataclass(frozen=True, eq=False)
class LivePart(Plain):
    """Rows of one stream that were judged since the last event, predicted by one revision before it learnt them.

    rows: all that were judged; counts: what became of them, by code; worst: (n) largest |tau - mean| of all of them in
    standard deviations of a measurement, NaN where none could be predicted; q: (n) positions of the newest row shown,
    rad (m). Of the rows shown, K of them: time: (K) Unix seconds; tau: (K, n) measured; mean: predicted; std: of the
    function, noise_std: (n) of a measurement around it, N·m; code: what became of each. NaN for what there is none of.
    """

    stream_id: str
    version: int
    revision: int
    rows: int
    counts: dict[str, int]
    worst: Array
    noise_std: Array
    q: Array
    time: Array
    tau: Array
    mean: Array
    std: Array
    code: tuple[str, ...]

    def __post_init__(self) -> None:
        shape_arrays(self, (len(self.time), len(self.noise_std)), "tau", "mean", "std")
        if not len(self.q):
            object.__setattr__(self, "q", np.full_like(self.noise_std, np.nan))

    @property
    def innovation(self) -> Array:
        """(K, n) of tau - mean in standard deviations of a measurement."""
        innovation: Array = (self.tau - self.mean) / np.hypot(self.std, self.noise_std)
        return innovation


@dataclass(frozen=True, eq=False)
class LiveRows:
    """Rows that came."""

    parts: tuple[LivePart, ...]


Live = LiveRows | LiveStatus | LiveLost | None
"""Rows, where the model stands (about once a second), how many events were lost; None for what a later release adds."""


_read_rows = reading(LiveRows)
_read_status, _read_lost = record(LiveStatus), record(LiveLost)


def read_live(answer: Answer) -> Live:
    """Read an event."""
    if answer.event == "rows":
        return _read_rows(answer)
    if answer.event == "status":
        return _read_status(answer)
    if answer.event == "lost":
        return _read_lost(answer)
    return None
