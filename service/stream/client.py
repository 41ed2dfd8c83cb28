"""A synchronous client of torque streams, for controllers on the same host or network."""

from __future__ import annotations

import json
import socket
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
from numpy.typing import ArrayLike
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from service.access.credentials import headers_of
from service.settings import DEFAULT_URL
from service.stream.frames import ASK_LEARN, ASK_STD, NUMBER, REQUEST
from service.stream.messages import (
    StreamAnswer,
    StreamError,
    StreamHello,
    StreamLearnt,
    StreamRefusal,
    read_answer,
    read_hello,
    read_refusal,
)

__all__ = ["StreamAnswer", "StreamClient", "StreamError", "StreamHello", "StreamLearnt", "StreamRefusal"]

_SEQUENCES = 1 << 32
_REFUSALS = 1000
"""Refusals kept: a robot that goes on where nothing is learnt must not fill the memory."""


class StreamClient:
    """One stream; use it as a context manager or close it. Not to be shared between threads.

    model: its name; unix: path of the service's Unix-domain socket, instead of host and port of the address; version:
    pins one, alias: follows what that points to, else the version that serves answers; timeout: longest wait for the
    connection, and for one answer, in s; stream_id: name of the source of the torques that are sent to learn from, None
    where only answers are wanted; first_sequence: of the first frame: to send frames again after a lost connection,
    take the first of them above `learnt.through`; key: API key, that of the environment variable LIPSERVE_KEY where
    None.
    hello: what the service said of the version that answers.
    Raise StreamError where the service cannot be reached or refuses.
    """

    def __init__(
        self,
        model: str,
        url: str = DEFAULT_URL,
        unix: Path | None = None,
        version: int | None = None,
        timeout: float = 10.0,
        stream_id: str | None = None,
        first_sequence: int = 1,
        alias: str | None = None,
        key: str | None = None,
    ) -> None:
        if not 0 <= first_sequence < _SEQUENCES:
            raise ValueError(f"first_sequence is {first_sequence}, expected 0 to {_SEQUENCES - 1}")
        headers = headers_of(key)
        self.timeout = timeout
        self._stream_id, self._sequence, self._stack = stream_id, first_sequence - 1, ExitStack()
        self._answers: deque[StreamAnswer | StreamError] = deque()
        self._unsettled: deque[int] = deque()
        self._learnt = StreamLearnt(first_sequence - 1)
        self._refusals: deque[StreamRefusal] = deque(maxlen=_REFUSALS)
        parts = urlsplit(url)
        secure = parts.scheme in ("https", "wss")
        query = {"version": version, "alias": alias, "stream_id": stream_id}
        asked = urlencode({name: value for name, value in query.items() if value is not None})
        path = f"/v1/models/{quote(model, safe='')}/stream" + (f"?{asked}" if asked else "")
        address = f"{'wss' if secure else 'ws'}://{parts.netloc}{path}"
        try:
            made = _connect(parts.hostname or "127.0.0.1", parts.port or (443 if secure else 80), unix, timeout)
            self._socket = self._stack.enter_context(
                connect(
                    address,
                    sock=made,
                    compression=None,
                    open_timeout=timeout,
                    close_timeout=1.0,
                    additional_headers=headers,
                )
            )
        except InvalidStatus as error:
            raise _refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {unix or url}: {error}", "unreachable") from error
        self.hello = self._hello(json.loads(self._receive(timeout)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    @property
    def learnt(self) -> StreamLearnt:
        """What the service has acknowledged of the torques sent over this connection, so far as it has been read."""
        return self._learnt

    @property
    def refusals(self) -> tuple[StreamRefusal, ...]:
        """The last 1000 times that the service could not log torques, so far as it has been read."""
        return tuple(self._refusals)

    def ask(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
    ) -> StreamAnswer:
        """Return the torque at one motion: q, dq, ddq of shape (n,) in SI units.

        deadline: seconds that the service may take before it counts the answer as late; 0 for none; tau: (n,) N·m, the
        torque measured there, to be learnt from after the answer.
        Raise StreamError where the service refuses the motion (the stream goes on), is gone, or does not answer in
        time: an answer that comes after all is dropped by the next call.
        """
        sequence = self.send(q, dq, ddq, std, deadline, tau)
        while True:
            try:
                answer = self.receive()
            except StreamError as error:
                if error.sequence is None or error.sequence == sequence:
                    raise
                continue
            if answer.sequence == sequence:
                return answer

    def send(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
    ) -> int:
        """Send one query, with torque to learn from or without, and return its sequence; `receive` has its answer."""
        parts = [np.ascontiguousarray(part, NUMBER) for part in (q, dq, ddq) + (() if tau is None else (tau,))]
        n = parts[0].size
        if any(part.shape != (n,) for part in parts):
            names = "q, dq and ddq" if tau is None else "q, dq, ddq and tau"
            shapes = ", ".join(str(part.shape) for part in parts)
            raise ValueError(f"{names} have the shapes {shapes}, expected (n,) each")
        flags = ASK_STD if std else 0
        if tau is not None:
            if self._stream_id is None:
                raise ValueError("tau is given, expected a client with stream_id, the name of what it was measured on")
            flags |= ASK_LEARN
        self._sequence = (self._sequence + 1) % _SEQUENCES
        header = REQUEST.pack(self._sequence, flags, n, deadline)
        if tau is not None:
            self._unsettled.append(self._sequence)
        try:
            self._socket.send(b"".join((header, *(part.tobytes() for part in parts))))
        except ConnectionClosed as error:
            raise _closed(error) from error
        return self._sequence

    def receive(self) -> StreamAnswer:
        """Return the answer to the oldest query without one; raise StreamError where it was refused."""
        while not self._answers:
            self._take(self._receive(self.timeout))
        answer = self._answers.popleft()
        if isinstance(answer, StreamError):
            raise answer
        return answer

    def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until every torque sent is acknowledged or refused, and return what has become of them.

        timeout: longest wait in s, the client's own where None. Answers that come meanwhile wait for `receive`.
        Raise StreamError where it takes longer, or the service is gone.
        """
        timeout = self.timeout if timeout is None else timeout
        end = monotonic() + timeout
        while self._unsettled:
            try:
                self._take(self._receive(max(end - monotonic(), 0.0)))
            except StreamError as error:
                if error.code != "timeout":
                    raise
                message = f"{len(self._unsettled)} torques are neither acknowledged nor refused within {timeout:g} s"
                raise StreamError(message, "timeout") from error
        return self._learnt

    def _take(self, data: str | bytes) -> None:
        """Keep what the service said."""
        if isinstance(data, bytes):
            answer = read_answer(data)
            self._answers.append(answer)
            if isinstance(answer, StreamError) and answer.sequence is not None:
                with suppress(ValueError):  # a frame without torque
                    self._unsettled.remove(answer.sequence)
            return
        said = json.loads(data)
        if "learnt" in said:
            self._learnt = self._learnt.and_more(said["learnt"])
            self._settle(said["learnt"]["through"])
        elif "refused" in said:
            self._refusals.append(read_refusal(said["refused"]))
            self._settle(said["refused"]["through"])
        else:
            self.hello = self._hello(said)

    def _settle(self, through: int) -> None:
        while self._unsettled and self._unsettled[0] <= through:
            self._unsettled.popleft()

    def _receive(self, timeout: float) -> str | bytes:
        try:
            return self._socket.recv(timeout)
        except TimeoutError as error:
            raise StreamError(f"no answer within {timeout:g} s", "timeout") from error
        except ConnectionClosed as error:
            raise _closed(error) from error

    def _hello(self, said: dict[str, Any]) -> StreamHello:
        try:
            return read_hello(said)
        except StreamError:
            self.close()
            raise


def _connect(host: str, port: int, unix: Path | None, timeout: float) -> socket.socket:
    """Open a connection without Nagle's delay, and without the proxy that a controller's environment may name."""
    if unix is not None:
        made = socket.socket(socket.AF_UNIX)
        try:
            made.settimeout(timeout)
            made.connect(str(unix))
        except OSError:
            made.close()
            raise
    else:
        made = socket.create_connection((host, port), timeout)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    made.settimeout(None)
    return made


def _refused(status: int, body: bytes | bytearray) -> StreamError:
    try:
        error = json.loads(body)["error"]
        return StreamError(error["message"], error["code"], error["detail"])
    except (ValueError, KeyError, TypeError):
        return StreamError(f"the service refused the stream with status {status}", "refused")


def _closed(error: ConnectionClosed) -> StreamError:
    if error.rcvd is None:
        return StreamError("the connection is lost", "closed")
    return StreamError(f"the service closed the stream: {error.rcvd.reason or error.rcvd.code}", "closed")
