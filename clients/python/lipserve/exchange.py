"""Frames and messages of torque streams, without transport."""

from __future__ import annotations

import json
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from time import monotonic
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray
from websockets.exceptions import ConnectionClosed

from lipserve.frames import (
    ANSWER,
    ASK_EXTERNAL,
    ASK_LEARN,
    ASK_STD,
    ERROR,
    FALLBACK,
    HAS_EXTERNAL,
    HAS_PAYLOAD,
    HAS_SCALE,
    HAS_STD,
    LATE,
    LAYOUT,
    NUMBER,
    REQUEST,
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


def read_answer(data: bytes) -> StreamAnswer | StreamError:
    """Read an answer frame, or the error in its place."""
    sequence, flags, n, version, late, revision, seconds = ANSWER.unpack_from(data)
    if flags & ERROR:
        error = json.loads(data[ANSWER.size :])["error"]
        return StreamError(error["message"], error["code"], error["detail"], None if flags & UNREAD else sequence)
    numbers = np.frombuffer(data, NUMBER, offset=ANSWER.size)
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


SEQUENCES = 1 << 32
WHY = ("code", "message", "detail")
_REFUSALS = 1000
"""Max number of refusals kept, to limit memory if the service refuses for a long time."""


class Destination(NamedTuple):
    """WebSocket address of a stream, with its host and port."""

    address: str
    host: str
    port: int


def destination(url: str, model: str, **query: int | str | None) -> Destination:
    """Return the destination of a model's stream at http://host:port. query: None values are omitted."""
    parts = urlsplit(url)
    secure = parts.scheme in ("https", "wss")
    encoded = urlencode({name: value for name, value in query.items() if value is not None})
    path = f"/v1/models/{quote(model, safe='')}/stream" + (f"?{encoded}" if encoded else "")
    address = f"{'wss' if secure else 'ws'}://{parts.netloc}{path}"
    return Destination(address, parts.hostname or "127.0.0.1", parts.port or (443 if secure else 80))


class Exchange:
    """State of one stream.

    Args:
        stream_id: Stream that sent torques belong to, None if none are learnt.
        first_sequence: Sequence of the first frame.

    Attributes:
        hello: Description of the version that answers, None until it has been received.
        answers: Received answers that were not returned yet.
        unsettled: Sequences of torques that are neither acknowledged nor refused.
        learnt: Acknowledged torques.
        refusals: Torques that could not be logged.
        late_answers: Number of late answers.
    """

    def __init__(self, stream_id: str | None, first_sequence: int) -> None:
        if not 0 <= first_sequence < SEQUENCES:
            raise ValueError(f"first_sequence is {first_sequence}, expected 0 to {SEQUENCES - 1}")
        self._stream_id, self._sequence = stream_id, first_sequence - 1
        self.hello: StreamHello | None = None
        self.answers: deque[StreamAnswer | StreamError] = deque()
        self.unsettled: deque[int] = deque()
        self.learnt = StreamLearnt(first_sequence - 1)
        self.refusals: deque[StreamRefusal] = deque(maxlen=_REFUSALS)
        self.late_answers = 0
        self._due: dict[int, float] = {}  # deadlines of open queries, by `monotonic`

    def frame(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool,
        deadline: float,
        tau: ArrayLike | None,
        external: bool = False,
        learn: bool = True,
    ) -> tuple[int, bytes]:
        """Return a query's sequence and the frame to send; raise ValueError. Arguments: see `StreamClient.predict`."""
        parts = [np.ascontiguousarray(part, NUMBER) for part in (q, dq, ddq) + (() if tau is None else (tau,))]
        n = parts[0].size
        if any(part.shape != (n,) for part in parts):
            names = "q, dq and ddq" if tau is None else "q, dq, ddq and tau"
            shapes = ", ".join(str(part.shape) for part in parts)
            raise ValueError(f"{names} have the shapes {shapes}, expected (n,) each")
        if external and tau is None:
            raise ValueError("`external` requires `tau`, the torque measured at this motion")
        learn = learn and tau is not None and self._stream_id is not None
        if tau is not None and not learn and not external:
            raise ValueError("`tau` has no effect: to learn from it, set `stream_id` of the client, or set `external`")
        flags = (ASK_STD if std else 0) | (ASK_LEARN if learn else 0) | (ASK_EXTERNAL if external else 0)
        self._sequence = (self._sequence + 1) % SEQUENCES
        if learn:
            self.unsettled.append(self._sequence)
        if deadline:
            self._due[self._sequence] = monotonic() + deadline
        header = REQUEST.pack(self._sequence, flags, n, deadline)
        return self._sequence, b"".join((header, *(part.tobytes() for part in parts)))

    def receive(self, data: str | bytes) -> None:
        """Process a message of the service; raise StreamError if its frame layout is not supported."""
        if isinstance(data, bytes):
            answer = self._timed(read_answer(data))
            self.answers.append(answer)
            if isinstance(answer, StreamError) and answer.sequence is not None:
                with suppress(ValueError):  # the frame had no torque
                    self.unsettled.remove(answer.sequence)
            return
        message = json.loads(data)
        if "learnt" in message:
            self.learnt = self.learnt.and_more(message["learnt"])
            self._settle(message["learnt"]["through"])
        elif "refused" in message:
            refused = message["refused"]
            self.refusals.append(
                StreamRefusal(refused["first"], refused["through"], *(refused["error"][name] for name in WHY))
            )
            self._settle(refused["through"])
        else:
            self.hello = read_hello(message)

    def _timed(self, answer: StreamAnswer | StreamError) -> StreamAnswer | StreamError:
        """Return the answer, marked as late or not by this client's clock."""
        due = None if answer.sequence is None else self._due.pop(answer.sequence, None)
        if due is None or isinstance(answer, StreamError):
            return answer
        late = monotonic() > due
        self.late_answers += late
        return replace(answer, late=late, late_answers=self.late_answers)

    def given_up(self, sequence: int) -> None:
        """Count a missing answer as late; if it arrives later, it is not counted again."""
        if self._due.pop(sequence, None) is not None:
            self.late_answers += 1

    def answer(self) -> StreamAnswer:
        """Remove and return the oldest answer; raise StreamError if its query was rejected."""
        answer = self.answers.popleft()
        if isinstance(answer, StreamError):
            raise answer
        return answer

    def _settle(self, through: int) -> None:
        while self.unsettled and self.unsettled[0] <= through:
            self.unsettled.popleft()


class StreamSide:
    """State of a stream that both stream clients expose."""

    _exchange: Exchange

    @property
    def hello(self) -> StreamHello:
        """Description of the version that answers, as last received."""
        assert self._exchange.hello is not None, "the stream is not open: use `async with`"
        return self._exchange.hello

    @property
    def learnt(self) -> StreamLearnt:
        """Acknowledged torques of this connection, as last received."""
        return self._exchange.learnt

    @property
    def refusals(self) -> tuple[StreamRefusal, ...]:
        """Last 1000 refusals to log torques, as received so far."""
        return tuple(self._exchange.refusals)


def refused(status: int, body: bytes | bytearray | None) -> StreamError:
    """Return the error for a stream that the service refused to open."""
    try:
        error: dict[str, Any] = json.loads(body or b"")["error"]
        return StreamError(error["message"], error["code"], error["detail"])
    except (ValueError, KeyError, TypeError):
        return StreamError(f"the service refused the stream with HTTP status {status}", "refused")


def closed(error: ConnectionClosed) -> StreamError:
    """Return the error for a closed connection."""
    if error.rcvd is None:
        return StreamError("the connection was lost", "closed")
    return StreamError(f"the service closed the stream: {error.rcvd.reason or error.rcvd.code}", "closed")


def unanswered(timeout: float) -> StreamError:
    """Return the error for a missing answer."""
    return StreamError(f"no answer within {timeout:g} s", "timeout")


def unsettled(count: int, timeout: float) -> StreamError:
    """Return the error for torques that were not acknowledged in time."""
    message = f"{count} torques were neither acknowledged nor refused within {timeout:g} s"
    return StreamError(message, "timeout")
