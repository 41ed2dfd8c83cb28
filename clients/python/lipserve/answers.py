"""Answers and messages of torque streams."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lipserve.frames import (
    ANSWER,
    ERROR,
    FALLBACK,
    HAS_CORIOLIS,
    HAS_EXTERNAL,
    HAS_GRAVITY,
    HAS_MASS_MATRIX,
    HAS_PAYLOAD,
    HAS_SCALE,
    HAS_STD,
    LATE,
    LAYOUT,
    NUMBER,
    UNREAD,
)


class StreamError(RuntimeError):
    """The service rejected a stream or a frame, or is not reachable.

    Attributes:
        message: Text for people.
        code: Error code of the service, or `unreachable`, `closed`, `timeout` or `layout`.
        detail: Problems, with field, value and expected.
        sequence: Sequence of the rejected frame; None if it is unknown or the whole stream failed.

    Example:
        >>> try:
        ...     answer = stream.predict(q, dq, ddq, deadline=0.001)
        ... except StreamError as error:
        ...     print(error.code)
        timeout
    """

    def __init__(
        self, message: str, code: str, detail: list[dict[str, Any]] | None = None, sequence: int | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.code, self.detail, self.sequence = message, code, detail or [], sequence


@dataclass(frozen=True)
class StreamHello:
    """Description of the version that answers.

    noise_std: (n,) standard deviation of a measurement around the predicted torque, N·m.
    """

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    noise_std: NDArray[np.float64]
    max_position: float


@dataclass(frozen=True, slots=True)
class StreamExternal:
    """External torque: measured torque that the model does not explain.

    Its cause may be contact, a payload, or an error of model or sensor. This is not a safety function.
    """

    tau: NDArray[np.float64]
    """(n,) measured − predicted torque, N·m."""
    std: NDArray[np.float64]
    """(n,) standard deviation of `tau` without external torque, N·m."""
    z: NDArray[np.float64]
    """(n,) tau / std."""
    statistic: float
    """T of the whole arm; without external torque it has a χ² distribution with n degrees of freedom."""
    p: float
    """P(χ² > T)."""


class StreamPayload(NamedTuple):
    """Estimated mass of a stream's payload and its standard deviation, kg; both NaN without a payload."""

    mass: float
    std: float


@dataclass(frozen=True, slots=True)
class StreamAnswer:
    """Predicted torque at one motion. Fields that were not requested are None."""

    sequence: int
    """Sequence of the query."""
    tau: NDArray[np.float64]
    """(n,) mean, N·m (prismatic: N)."""
    tau_std: NDArray[np.float64] | None
    """(n,) standard deviation of the predicted torque, without measurement noise."""
    version: int
    """Version that answered."""
    revision: int
    """Revision that answered."""
    late: bool
    """Whether the answer came after the deadline, by this client's clock."""
    late_answers: int
    """Number of late answers of this connection, including this one."""
    seconds: float
    """Time from the arrival of the frame in the service to the departure of the answer, s."""
    scale: NDArray[np.float64] | None = None
    """(n,) factor on the half width of intervals."""
    external: StreamExternal | None = None
    """External torque."""
    payload: StreamPayload | None = None
    """Estimated payload."""
    fallback: bool = False
    """Whether the training data do not determine some joint's torque at this motion.

    That torque is then gravity, offset and friction only, or the mean of the training data.
    """


@dataclass(frozen=True, slots=True)
class StreamPart:
    """Gravity, mass matrix or Coriolis torque at one state."""

    sequence: int
    """Sequence of the query."""
    mean: NDArray[np.float64]
    """(n,) torque, N·m (prismatic: N), or (n, n) mass matrix, kg·m²."""
    std: NDArray[np.float64] | None
    """(n,) standard deviation of gravity; else None."""
    version: int
    """Version that answered."""
    revision: int
    """Revision that answered."""
    late: bool
    """Whether the answer came after the deadline, by this client's clock."""
    late_answers: int
    """Number of late answers of this connection, including this one."""
    seconds: float
    """Time from the arrival of the frame in the service to the departure of the answer, s."""


StreamReply = StreamAnswer | StreamPart
"""An answer that is not an error."""


@dataclass(frozen=True)
class StreamLearnt:
    """Acknowledged torques of a stream; all of them are durable."""

    through: int
    """Last sequence that is acknowledged or refused; before the first, the client's first sequence − 1."""
    accepted: int = 0
    """Number of torques that are new and learnt from."""
    duplicates: int = 0
    """Number of torques that were logged before."""
    rejected: dict[str, int] = field(default_factory=dict)
    """Number of torques that are not learnt from, by code."""
    revision: int = 0
    """Answers of this revision and later ones include these torques."""

    def and_more(self, message: dict[str, Any]) -> StreamLearnt:
        """Return the totals after another message of the service."""
        rejected = dict(Counter(self.rejected) + Counter(message["rejected"]))
        return StreamLearnt(
            through=message["through"],
            accepted=self.accepted + message["accepted"],
            duplicates=self.duplicates + message["duplicates"],
            rejected=rejected,
            revision=max(self.revision, message["revision"]),
        )


@dataclass(frozen=True)
class StreamRefusal:
    """Torques with sequences `first` to `through` that the service could not log, and the reason."""

    first: int
    through: int
    code: str
    message: str
    detail: list[dict[str, Any]]


def read_hello(message: dict[str, Any]) -> StreamHello:
    """Read the first message of a stream; raise StreamError if this client does not support its frame layout."""
    if message["layout"] != LAYOUT:
        raise StreamError(
            f"the service uses frame layout {message['layout']}; this client supports {LAYOUT}: install the client of "
            "the service's release",
            "layout",
        )
    known = {each.name: message[each.name] for each in fields(StreamHello)}
    known |= {"joint_names": tuple(message["joint_names"]), "noise_std": np.array(message["noise_std"])}
    return StreamHello(**known)


def read_answer(data: bytes) -> StreamReply | StreamError:
    """Read an answer frame, or the error in its place."""
    sequence, flags, n, version, late, revision, seconds = ANSWER.unpack_from(data)
    if flags & ERROR:
        error = json.loads(data[ANSWER.size :])["error"]
        return StreamError(error["message"], error["code"], error["detail"], None if flags & UNREAD else sequence)
    numbers = np.frombuffer(data, NUMBER, offset=ANSWER.size)
    if flags & (HAS_GRAVITY | HAS_CORIOLIS | HAS_MASS_MATRIX):
        mean = numbers.reshape(n, n) if flags & HAS_MASS_MATRIX else numbers[:n]
        std = numbers[n:] if flags & HAS_STD else None
        return StreamPart(sequence, mean, std, version, revision, bool(flags & LATE), late, seconds)
    carried = None
    if flags & HAS_PAYLOAD:
        numbers, carried = numbers[:-2], StreamPayload(*numbers[-2:].tolist())
    std = numbers[n : 2 * n] if flags & HAS_STD else None
    external = None
    if flags & HAS_EXTERNAL:
        numbers, last = numbers[: -3 * n - 2], numbers[-3 * n - 2 :]
        external = StreamExternal(*last[:-2].reshape(3, n), *last[-2:].tolist())
    scale = numbers[-n:] if flags & HAS_SCALE else None
    tau, missed = numbers[:n], bool(flags & LATE)
    fallback = bool(flags & FALLBACK)
    return StreamAnswer(
        sequence, tau, std, version, revision, missed, late, seconds, scale, external, carried, fallback
    )
