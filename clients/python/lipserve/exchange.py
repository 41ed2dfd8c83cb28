"""Frames and messages of torque streams, without transport."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from time import monotonic
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from numpy.typing import ArrayLike, NDArray
from websockets.exceptions import ConnectionClosed

from lipserve.answers import (
    StreamAnswer,
    StreamError,
    StreamHello,
    StreamLearnt,
    StreamRefusal,
    StreamReply,
    read_answer,
    read_hello,
)
from lipserve.frames import ASK_EXTERNAL, ASK_LEARN, ASK_STD, NUMBER, REQUEST

Vector = NDArray[np.float64]
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
        self.answers: deque[StreamReply | StreamError] = deque()
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
        more, names = ((), "q, dq and ddq") if tau is None else ((tau,), "q, dq, ddq and tau")
        vectors = _vectors(names, q, dq, ddq, *more)
        if external and tau is None:
            raise ValueError("`external` requires `tau`, the torque measured at this motion")
        learn = learn and tau is not None and self._stream_id is not None
        if tau is not None and not learn and not external:
            raise ValueError("`tau` has no effect: to learn from it, set `stream_id` of the client, or set `external`")
        flags = (ASK_STD if std else 0) | (ASK_LEARN if learn else 0) | (ASK_EXTERNAL if external else 0)
        sequence, frame = self._framed(flags, deadline, vectors)
        if learn:
            self.unsettled.append(sequence)
        return sequence, frame

    def part_frame(self, flags: int, deadline: float, q: ArrayLike, *dq: ArrayLike) -> tuple[int, bytes]:
        """Return a query of gravity, mass matrix or Coriolis torque as `frame`; raise ValueError."""
        return self._framed(flags, deadline, _vectors("q and dq" if dq else "q", q, *dq))

    def _framed(self, flags: int, deadline: float, vectors: Sequence[Vector]) -> tuple[int, bytes]:
        self._sequence = (self._sequence + 1) % SEQUENCES
        if deadline:
            self._due[self._sequence] = monotonic() + deadline
        header = REQUEST.pack(self._sequence, flags, vectors[0].size, deadline)
        return self._sequence, b"".join((header, *(each.tobytes() for each in vectors)))

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

    def _timed(self, answer: StreamReply | StreamError) -> StreamReply | StreamError:
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

    def reply(self) -> StreamReply:
        """Remove and return the oldest answer; raise StreamError if its query was rejected."""
        answer = self.answers.popleft()
        if isinstance(answer, StreamError):
            raise answer
        return answer

    def answer(self) -> StreamAnswer | None:
        """Return `reply`, dropping answers to queries of a part that were given up; None if there is none."""
        while self.answers:
            if isinstance(answer := self.reply(), StreamAnswer):
                return answer
        return None

    def _settle(self, through: int) -> None:
        while self.unsettled and self.unsettled[0] <= through:
            self.unsettled.popleft()


def _vectors(names: str, *values: ArrayLike) -> list[Vector]:
    """Return vectors of one length as arrays; raise ValueError. names: of the values."""
    vectors = [np.ascontiguousarray(each, NUMBER) for each in values]
    if any(each.shape != (vectors[0].size,) for each in vectors):
        shapes = ", ".join(str(each.shape) for each in vectors)
        have, which = ("has the shape", "") if len(vectors) == 1 else ("have the shapes", " each")
        raise ValueError(f"{names} {have} {shapes}, expected (n,){which}")
    return vectors


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
