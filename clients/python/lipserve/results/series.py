"""Predicted torques with uncertainty: of queries, of recordings and live; and recordings thinned for a plot."""

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
    """Return the ends of the central interval that contains a measurement with probability `level`.

    Args:
        mean: (…, n) predicted torque, N·m.
        std: (…, n) standard deviation of the predicted torque.
        noise_std: (n,) standard deviation of a measurement around it.
        level: Probability.
        scale: (n,) factor on the half width. Default: 1.

    Raises:
        ValueError: The level is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level is {level}, expected a probability between 0 and 1")
    half = NormalDist().inv_cdf((1 + level) / 2) * np.hypot(std, noise_std)
    half = half if scale is None else half * scale
    return mean - half, mean + half


@dataclass(frozen=True, eq=False)
class Component(Plain):
    """Component of the dynamics, such as gravity or the inertia matrix, at one or N motions.

    Example:
        >>> answer = client.predict("panda-sim", q, dq, ddq, components=["gravity"])
        >>> answer.components["gravity"].mean
    """

    mean: Array
    """() or (N,) for scalars, (…, n) for vectors, (…, n, n) for matrices."""
    std: Array
    """Standard deviation, shaped as `mean`; for forward dynamics to first order."""


@dataclass(frozen=True, eq=False)
class Wrench(Plain):
    """Force, N, and moment about the origin of the last link or tool, N·m, that act on the arm, at one or N motions.

    Example:
        >>> answer = client.wrench("my-ur10", q, dq, ddq, tau)
        >>> answer.base, answer.base_std
    """

    link: Array
    """(6,) or (N, 6), in the axes of the last link or tool."""
    link_covariance: Array
    """(6, 6) or (N, 6, 6)."""
    base: Array
    """In the axes of the base."""
    base_covariance: Array
    """(6, 6) or (N, 6, 6)."""

    @property
    def link_std(self) -> Array:
        """Standard deviations in the axes of the last link or tool, (6,) or (N, 6)."""
        return np.sqrt(np.diagonal(self.link_covariance, axis1=-2, axis2=-1))

    @property
    def base_std(self) -> Array:
        """Standard deviations in the axes of the base, (6,) or (N, 6)."""
        return np.sqrt(np.diagonal(self.base_covariance, axis1=-2, axis2=-1))


@dataclass(frozen=True, eq=False)
class Prediction(Plain):
    """Predicted torques at one motion, (n,), or N motions, (N, n).

    Example:
        >>> answer = client.predict("panda-sim", [0.0] * 7, [0.0] * 7, [0.0] * 7)
        >>> lower, upper = answer.interval(0.95)
    """

    model: str
    version: int
    revision: int
    """Revision of the version: number of online updates."""
    joint_names: tuple[str, ...]
    torque_convention: str
    tau: Array
    """(…, n) mean, N·m (prismatic: N)."""
    tau_std: Array
    """(…, n) standard deviation of the predicted torque, without measurement noise. It grows away from the data."""
    noise_std: Array
    """(n,) standard deviation of a measurement around the torque."""
    scale: Array | None = None
    """(n,) factor on the half width of intervals, adapted to recent streams; None from older services."""
    guaranteed: Array | None = None
    """(n,) guaranteed coverage of 95 % intervals, from left-out blocks of the training; None for the shipped model."""
    covariance: Array | None = None
    """(…, n, n) covariance of the torque between joints, (N·m)², if requested."""
    components: Mapping[str, Component] | None = None
    """Components by name, if requested."""
    fallback: Array | None = None
    """(…, n) share of the fallback in each torque; None if all are zero.

    At 1, the training data do not determine the torque: it is gravity, offset and friction only, or the mean of the
    training data.
    """

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends of the central interval for a *measurement*.

        The interval includes measurement noise: tau ± z · scale · √(tau_std² + noise_std²).

        Args:
            level: Probability that a measurement is inside.

        Returns:
            Lower and upper end, shaped as `tau`.

        Raises:
            ValueError: The level is not between 0 and 1.
        """
        return interval(self.tau, self.tau_std, self.noise_std, level, self.scale)


read_component = reading(Component)
read_wrench = reading(Wrench)
read_prediction = reading(Prediction)


@dataclass(frozen=True, eq=False)
class PreviewColumn(Plain):
    """K points of one quantity of one joint."""

    quantity: str
    joint: str
    unit: str
    rows: NDArray[np.int64]
    """(K,) rows, counted from 0."""
    t: Array
    """(K,) times, s."""
    values: Array
    """(K,) values in `unit`."""


@dataclass(frozen=True, eq=False)
class Preview(Plain):
    """Columns of a data set, thinned for a plot with all extremes kept.

    Example:
        >>> column = client.preview("ds_0123456789abcdef").column("tau", "joint1")
        >>> column.t, column.values
    """

    samples: int
    """Number of rows of the data set."""
    starts: NDArray[np.int64]
    """First rows of the episodes."""
    columns: tuple[PreviewColumn, ...]

    def column(self, quantity: str, joint: str) -> PreviewColumn:
        """Return one column; raise KeyError if there is none."""
        for each in self.columns:
            if (each.quantity, each.joint) == (quantity, joint):
                return each
        raise KeyError(f"no column for {quantity} of {joint}")


read_preview = reading(Preview)


@dataclass(frozen=True, eq=False)
class Trace(Plain):
    """Measured and predicted torques at K rows of a data set, N·m (prismatic: N).

    Example:
        >>> trace = client.trace("panda-sim", "ds_0123456789abcdef")
        >>> residual = trace.tau - trace.mean
    """

    model: str
    version: int
    revision: int
    dataset: str
    part: str
    """`all` or `held_out`."""
    joint_names: tuple[str, ...]
    torque_convention: str
    samples: int
    """Number of samples of the data set or part."""
    in_range: int
    """Number of samples between start and stop."""
    shown: int
    """K. If there are more samples, they are chosen evenly, so peaks may be missing."""
    rows: NDArray[np.int64]
    """(K,) rows, counted from 0."""
    t: Array
    """(K,) times, s."""
    breaks: NDArray[np.int64]
    """Indices in `rows` at which a plotted line must be interrupted."""
    tau: Array
    """(K, n) measured torque."""
    mean: Array
    """(K, n) predicted torque."""
    std: Array
    """(K, n) standard deviation of the predicted torque."""
    noise_std: Array
    """(n,) standard deviation of a measurement around it."""
    offered: tuple[str, ...]
    """Names of components that can be requested."""
    components: Mapping[str, Component]
    """Components by name, if requested."""
    in_training: bool
    """Whether the model was trained on these samples: then it looks better than it is."""
    scale: Array | None = None
    """(n,) factor on the half width of intervals; None from older services."""

    def __post_init__(self) -> None:
        shape = (len(self.rows), len(self.joint_names))
        for each in (self, *self.components.values()):
            shape_arrays(each, shape, *({"tau", "mean", "std"} & vars(each).keys()))

    def interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends, (K, n), of the central interval for *measurements*; see `Prediction.interval`."""
        return interval(self.mean, self.std, self.noise_std, level, self.scale)


read_trace = reading(Trace)


@dataclass(frozen=True, eq=False)
class LivePart(Plain):
    """New rows of one stream, predicted by one revision before it learns from them. Missing numbers are NaN."""

    stream_id: str
    version: int
    revision: int
    rows: int
    """Number of rows since the last event; K of them are included."""
    counts: dict[str, int]
    """Number of rows by code."""
    worst: Array
    """(n,) largest |innovation| of all rows."""
    noise_std: Array
    """(n,) standard deviation of a measurement around the predicted torque, N·m."""
    q: Array
    """(n,) positions of the newest included row, rad (prismatic: m)."""
    time: Array
    """(K,) Unix times, s."""
    tau: Array
    """(K, n) measured torque, N·m."""
    mean: Array
    """(K, n) predicted torque, N·m."""
    std: Array
    """(K, n) standard deviation of the predicted torque, N·m."""
    code: tuple[str, ...]
    """Code of each included row."""

    def __post_init__(self) -> None:
        shape_arrays(self, (len(self.time), len(self.noise_std)), "tau", "mean", "std")
        if not len(self.q):
            object.__setattr__(self, "q", np.full_like(self.noise_std, np.nan))

    @property
    def innovation(self) -> Array:
        """(K, n) tau − mean, in predictive standard deviations including noise."""
        innovation: Array = (self.tau - self.mean) / np.hypot(self.std, self.noise_std)
        return innovation


@dataclass(frozen=True, eq=False)
class LiveRows:
    """Event of `Client.live` with new rows, in parts by stream and revision.

    Example:
        >>> for event in client.live("my-arm"):
        ...     if isinstance(event, LiveRows):
        ...         print([part.worst for part in event.parts])
    """

    parts: tuple[LivePart, ...]


Live = LiveRows | LiveStatus | LiveLost | None
"""Rows, state of the model (about once a second), or number of lost events; None for events of later releases."""


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
