"""What a client of torque streams sends and reads, without any transport."""

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
    """The service refused a connection or a frame, or is gone.

    code: as the service says, else `unreachable`, `closed`, `timeout` or `layout`; detail: its problems; sequence: of
    the frame that was refused, None where it could not be read.
    """

    def __init__(
        self, message: str, code: str, detail: list[dict[str, Any]] | None = None, sequence: int | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.code, self.detail, self.sequence = message, code, detail or [], sequence


@dataclass(frozen=True)
class StreamHello:
    """What holds for all answers of a version. noise_std: (n,) N·m, of the measurement around the function."""

    model: str
    version: int
    revision: int
    joint_names: tuple[str, ...]
    torque_convention: str
    noise_std: NDArray[np.float64]
    max_position: float


@dataclass(frozen=True, slots=True)
class StreamExternal:
    """What of a measured torque the model does not explain: a touch, a payload, or an error of model or sensor. Not a
    safety function.

    tau: (n,) measured − mean, N·m; std: (n,) standard deviation of that where nothing touches the arm; z: (n,) tau /
    std; statistic: T of the arm as one, χ² with n degrees of freedom then; p: its probability to be larger than T.
    """

    tau: NDArray[np.float64]
    std: NDArray[np.float64]
    z: NDArray[np.float64]
    statistic: float
    p: float


class StreamPayload(NamedTuple):
    """Mass that a stream's robot carries, kg; both NaN where it carries nothing as far as is known."""

    mass: float
    std: float


@dataclass(frozen=True, slots=True)
class StreamAnswer:
    """Torque at one motion, N·m.

    tau: (n,) mean; tau_std: (n,) standard deviation of the function, where asked for; late: whether more than the
    deadline has passed from sending the query to having its answer, by this client's clock; late_answers: how many of
    this connection have been late, this one included; seconds: from the arrival of the frame in the service to the
    departure of the answer; scale: (n,) factor on the half width of intervals that hold measurements, external: torque
    that is not explained, payload: what the arm carries, where asked for; fallback: whether some joint's torque went
    back to gravity, offset and friction, or to the training's mean, because the training does not determine it at this
    motion.
    """

    sequence: int
    tau: NDArray[np.float64]
    tau_std: NDArray[np.float64] | None
    version: int
    revision: int
    late: bool
    late_answers: int
    seconds: float
    scale: NDArray[np.float64] | None = None
    external: StreamExternal | None = None
    payload: StreamPayload | None = None
    fallback: bool = False


@dataclass(frozen=True)
class StreamLearnt:
    """What has become of the torques that a client sent; all of it is durable.

    through: the last sequence that is settled, one less than the client's first where none is; accepted: how many are
    new and learnt from; duplicates: were known before; rejected: kept out of learning, by code; revision: answers of it
    and above contain them.
    """

    through: int
    accepted: int = 0
    duplicates: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    revision: int = 0

    def and_more(self, message: dict[str, Any]) -> StreamLearnt:
        """Return the totals after one more message of the service."""
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
    """Torques that the service could not log: those with sequences first to through. code, message, detail: why."""

    first: int
    through: int
    code: str
    message: str
    detail: list[dict[str, Any]]


def read_hello(message: dict[str, Any]) -> StreamHello:
    """Read what holds for all answers; raise StreamError where frames have another layout than this client's."""
    if message["layout"] != LAYOUT:
        raise StreamError(f"the service's frames have layout {message['layout']}, this client knows {LAYOUT}", "layout")
    known = {each.name: message[each.name] for each in fields(StreamHello)}
    known |= {"joint_names": tuple(message["joint_names"]), "noise_std": np.array(message["noise_std"])}
    return StreamHello(**known)


def read_answer(data: bytes) -> StreamAnswer | StreamError:
    """Read an answer frame, or the error that is in its place."""
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
"""Refusals kept: a robot that goes on where nothing is learnt must not fill the memory."""


class Destination(NamedTuple):
    """Where a stream goes: its address as a WebSocket's, and host and port of it."""

    address: str
    host: str
    port: int


def destination(url: str, model: str, **query: int | str | None) -> Destination:
    """Where the stream of a model is, of a service at http://host:port; query: what of it is not None."""
    parts = urlsplit(url)
    secure = parts.scheme in ("https", "wss")
    asked = urlencode({name: value for name, value in query.items() if value is not None})
    path = f"/v1/models/{quote(model, safe='')}/stream" + (f"?{asked}" if asked else "")
    address = f"{'wss' if secure else 'ws'}://{parts.netloc}{path}"
    return Destination(address, parts.hostname or "127.0.0.1", parts.port or (443 if secure else 80))


class Exchange:
    """One stream's state. stream_id: whether torques may be sent; first_sequence: of the first frame.

    hello: what the service said of the version that answers, None before it has; answers: those that nobody has taken;
    unsettled: sequences of torques that are neither acknowledged nor refused; learnt, refusals: see `StreamClient`.
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
        self._due: dict[int, float] = {}  # by this client's clock, of queries with a deadline that have no answer

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
            raise ValueError("tau is missing, expected the torque measured at this motion, to tell what is external")
        learn = learn and tau is not None and self._stream_id is not None
        if tau is not None and not learn and not external:
            source = "a client with stream_id, the name of what it was measured on, and learn"
            raise ValueError(f"tau is given, expected {source}, or external")
        flags = (ASK_STD if std else 0) | (ASK_LEARN if learn else 0) | (ASK_EXTERNAL if external else 0)
        self._sequence = (self._sequence + 1) % SEQUENCES
        if learn:
            self.unsettled.append(self._sequence)
        if deadline:
            self._due[self._sequence] = monotonic() + deadline
        header = REQUEST.pack(self._sequence, flags, n, deadline)
        return self._sequence, b"".join((header, *(part.tobytes() for part in parts)))

    def take(self, data: str | bytes) -> None:
        """Keep what the service said; raise StreamError where it speaks another layout."""
        if isinstance(data, bytes):
            answer = self._timed(read_answer(data))
            self.answers.append(answer)
            if isinstance(answer, StreamError) and answer.sequence is not None:
                with suppress(ValueError):  # a frame without torque
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
        """The answer, late or not by this client's clock."""
        due = None if answer.sequence is None else self._due.pop(answer.sequence, None)
        if due is None or isinstance(answer, StreamError):
            return answer
        late = monotonic() > due
        self.late_answers += late
        return replace(answer, late=late, late_answers=self.late_answers)

    def given_up(self, sequence: int) -> None:
        """Count an answer as late that has not come; it is not counted again where it comes after all."""
        if self._due.pop(sequence, None) is not None:
            self.late_answers += 1

    def answer(self) -> StreamAnswer:
        """Take the oldest answer; raise what is in its place where the query was refused."""
        answer = self.answers.popleft()
        if isinstance(answer, StreamError):
            raise answer
        return answer

    def _settle(self, through: int) -> None:
        while self.unsettled and self.unsettled[0] <= through:
            self.unsettled.popleft()


class StreamSide:
    """What every client of a stream tells of it. _exchange: its state."""

    _exchange: Exchange

    @property
    def hello(self) -> StreamHello:
        """What the service said of the version that answers, so far as it has been read."""
        assert self._exchange.hello is not None, "the stream is not open: use `async with`"
        return self._exchange.hello

    @property
    def learnt(self) -> StreamLearnt:
        """What the service has acknowledged of the torques sent over this connection, so far as it has been read."""
        return self._exchange.learnt

    @property
    def refusals(self) -> tuple[StreamRefusal, ...]:
        """The last 1000 times that the service could not log torques, so far as it has been read."""
        return tuple(self._exchange.refusals)


def refused(status: int, body: bytes | bytearray | None) -> StreamError:
    """The error of a connection that could not be had."""
    try:
        error: dict[str, Any] = json.loads(body or b"")["error"]
        return StreamError(error["message"], error["code"], error["detail"])
    except (ValueError, KeyError, TypeError):
        return StreamError(f"the service refused the stream with status {status}", "refused")


def closed(error: ConnectionClosed) -> StreamError:
    """The error of a connection that has ended."""
    if error.rcvd is None:
        return StreamError("the connection is lost", "closed")
    return StreamError(f"the service closed the stream: {error.rcvd.reason or error.rcvd.code}", "closed")


def unanswered(timeout: float) -> StreamError:
    """The error of an answer that has not come in time."""
    return StreamError(f"no answer within {timeout:g} s", "timeout")


def unsettled(count: int, timeout: float) -> StreamError:
    """The error of torques of which nothing was heard in time."""
    message = f"{count} torques are neither acknowledged nor refused within {timeout:g} s"
    return StreamError(message, "timeout")
