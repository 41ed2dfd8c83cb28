"""Clients of torque streams, for controllers on the same host or network: one that waits, and one that is awaited."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any, Self
from warnings import warn

from numpy.typing import ArrayLike
from websockets.asyncio import client as awaited
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from lipserve.address import Address, headers_of, url_of
from lipserve.exchange import (
    Exchange,
    StreamAnswer,
    StreamError,
    StreamExternal,
    StreamHello,
    StreamLearnt,
    StreamRefusal,
    StreamSide,
    closed,
    destination,
    refused,
    unanswered,
    unsettled,
)

__all__ = [
    "AsyncStreamClient",
    "StreamAnswer",
    "StreamClient",
    "StreamError",
    "StreamExternal",
    "StreamHello",
    "StreamLearnt",
    "StreamRefusal",
]


PATIENCE_S = 10.0
"""Shortest that this wait may be, s: a control loop's `timeout` may be shorter."""
ASK_WARNING = "{0}.ask is called predict since 0.3. Use {0}.predict: 0.4 removes ask."


class _Stream(StreamSide):
    """What both clients do alike; arguments: see `StreamClient`."""

    def __init__(
        self,
        model: str,
        url: str | None = None,
        unix: Path | str | None = None,
        version: int | None = None,
        timeout: float = 1.0,
        stream_id: str | None = None,
        first_sequence: int = 1,
        alias: str | None = None,
        key: str | None = None,
        scale: bool = False,
        payload: bool = False,
    ) -> None:
        headers = headers_of(key)
        address = Address.of(url_of(url))
        self.timeout, self._url = timeout, address.base
        self._unix = address.unix if unix is None else Path(unix)
        self._exchange = Exchange(stream_id, first_sequence)
        asked = {"version": version, "alias": alias, "stream_id": stream_id}
        asked |= {"scale": 1 if scale else None, "payload": 1 if payload else None}
        self._destination = destination(address.base, model, **asked)
        self._options: dict[str, Any] = {
            "compression": None,
            "open_timeout": self._patience,
            "close_timeout": 1.0,
            "additional_headers": headers,
        }
        self._begin()

    @property
    def _patience(self) -> float:
        """Longest wait for a connection and for acknowledgements, in s."""
        return max(PATIENCE_S, self.timeout)

    def _begin(self) -> None:
        """Open the stream where making a client does so."""

    @contextmanager
    def _opening(self) -> Iterator[None]:
        """Raise StreamError for what keeps the block from connecting."""
        try:
            yield
        except InvalidStatus as error:
            raise refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {self._unix or self._url}: {error}", "unreachable") from error

    _last: StreamAnswer | None = None  # that came in time

    def _until(self, deadline: float) -> float:
        """Until when an answer is waited for, by `monotonic`."""
        return monotonic() + (deadline or self.timeout)

    def _in_time(self, answer: StreamAnswer) -> StreamAnswer:
        """The answer, or the last one that came in time."""
        if not answer.late:
            self._last = answer
            return answer
        return answer if self._last is None else self._held()

    def _late(self, sequence: int, deadline: float, error: StreamError) -> StreamAnswer:
        """What is answered in the place of an answer that has not come by its deadline."""
        if error.code != "timeout":
            raise error
        self._exchange.given_up(sequence)
        if not deadline or self._last is None:
            raise unanswered(deadline or self.timeout) from error
        return self._held()

    def _held(self) -> StreamAnswer:
        assert self._last is not None
        return replace(self._last, late=True, late_answers=self._exchange.late_answers)

    def _answer_to(self, sequence: int) -> StreamAnswer | None:
        """The answer to a query if it has come, those before it dropped; raise StreamError where it was refused."""
        while self._exchange.answers:
            try:
                answer = self._exchange.answer()
            except StreamError as error:
                if error.sequence is None or error.sequence == sequence:
                    raise
                continue
            if answer.sequence == sequence:
                return answer
        return None


class StreamClient(_Stream):
    """One stream; use it as a context manager or close it. Not to be shared between threads.

    model: its name; url, key: as of `Client`; unix: path of the service's Unix-domain socket, instead of host and port
    of the address; version: pins one, alias: follows what that points to, else the version that serves answers;
    timeout: longest wait for an answer without a deadline, in s; stream_id: name of the source of the torques
    that are sent to learn from, None where only answers are wanted; first_sequence: of the first frame: to send frames
    again after a lost connection, take the first of them above `learnt.through`; scale, payload: whether answers carry
    the factor on the half width of their intervals, and what the arm carries.
    Raise StreamError where the service cannot be reached or refuses.
    """

    def _begin(self) -> None:
        self._stack = ExitStack()
        address, host, port = self._destination
        with self._opening():
            made = _connect(host, port, self._unix, self._patience)
            self._socket = self._stack.enter_context(connect(address, sock=made, **self._options))
        self._take(self._patience)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._stack.close()

    def predict(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> StreamAnswer:
        """Return the torque at one motion: q, dq, ddq of shape (n,) in SI units.

        deadline: seconds from this call on after which it returns the last answer that came in time, with its own
        sequence, as `late`; 0 for none, then it waits for `timeout`. tau: (n,) N·m, the torque measured there, to be
        learnt from after the answer where the client has a stream_id, unless learn is false; external: whether to
        answer how much of tau the model does not explain.
        Raise StreamError where the service refuses the motion (the stream goes on), is gone, or does not answer in time
        (code `timeout`) and no answer has come in time before. One that comes after all is dropped by the next call.
        """
        end = self._until(deadline)
        sequence = self.send(q, dq, ddq, std, deadline, tau, external, learn)
        while (answer := self._answer_to(sequence)) is None:
            try:
                self._take(max(0.0, end - monotonic()))
            except StreamError as error:
                return self._late(sequence, deadline, error)
        return self._in_time(answer)

    def ask(self, *args: Any, **options: Any) -> StreamAnswer:
        """Deprecated name of `predict`."""
        warn(ASK_WARNING.format("StreamClient"), DeprecationWarning, stacklevel=2)
        return self.predict(*args, **options)

    def send(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> int:
        """Send one query, with torque or without, and return its sequence; `receive` has its answer."""
        sequence, frame = self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn)
        try:
            self._socket.send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    def receive(self) -> StreamAnswer:
        """Return the answer to the oldest query without one; raise StreamError where it was refused."""
        while not self._exchange.answers:
            self._take(self.timeout)
        return self._exchange.answer()

    def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until every torque sent is acknowledged or refused, and return what has become of them.

        timeout: longest wait in s, 10 where None. Answers that come meanwhile wait for `receive`.
        Raise StreamError where it takes longer, or the service is gone.
        """
        timeout = self._patience if timeout is None else timeout
        end = monotonic() + timeout
        while self._exchange.unsettled:
            try:
                self._take(max(end - monotonic(), 0.0))
            except StreamError as error:
                if error.code != "timeout":
                    raise
                raise unsettled(len(self._exchange.unsettled), timeout) from error
        return self._exchange.learnt

    def _take(self, timeout: float) -> None:
        """Read one message."""
        try:
            message = self._socket.recv(timeout)
        except TimeoutError as error:
            raise unanswered(timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
        try:
            self._exchange.take(message)
        except StreamError:  # of a layout that this client cannot read
            self.close()
            raise


class AsyncStreamClient(_Stream):
    """One stream, open while `async with` lasts. Not to be shared between tasks.

    Arguments, methods and errors are those of `StreamClient`; methods that wait are awaited.
    """

    _connection: awaited.ClientConnection | None = None

    async def __aenter__(self) -> Self:
        address = self._destination.address
        with self._opening():
            if self._unix is None:
                # the proxy that an environment may name is not for controllers
                self._connection = await awaited.connect(address, proxy=None, **self._options)
            else:
                self._connection = await awaited.unix_connect(str(self._unix), address, **self._options)
        try:
            await self._take(self._patience)
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            await self._connection.close()

    async def predict(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> StreamAnswer:
        """Return the torque at one motion; see `StreamClient.predict`. Where the task is cancelled meanwhile, the
        answer is dropped by the next call."""
        end = self._until(deadline)
        sequence = await self.send(q, dq, ddq, std, deadline, tau, external, learn)
        while (answer := self._answer_to(sequence)) is None:
            try:
                await self._take(max(0.0, end - monotonic()))
            except StreamError as error:
                return self._late(sequence, deadline, error)
        return self._in_time(answer)

    async def ask(self, *args: Any, **options: Any) -> StreamAnswer:
        """Deprecated name of `predict`."""
        warn(ASK_WARNING.format("AsyncStreamClient"), DeprecationWarning, stacklevel=2)
        return await self.predict(*args, **options)

    async def send(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
        external: bool = False,
        learn: bool = True,
    ) -> int:
        """Send one query, with torque or without, and return its sequence; `receive` has its answer."""
        sequence, frame = self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn)
        try:
            await self._open().send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    async def receive(self) -> StreamAnswer:
        """Return the answer to the oldest query without one; raise StreamError where it was refused."""
        while not self._exchange.answers:
            await self._take(self.timeout)
        return self._exchange.answer()

    async def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until every torque sent is acknowledged or refused; see `StreamClient.flush`."""
        timeout = self._patience if timeout is None else timeout
        try:
            async with asyncio.timeout(timeout):
                while self._exchange.unsettled:
                    await self._take(None)
        except TimeoutError as error:
            raise unsettled(len(self._exchange.unsettled), timeout) from error
        return self._exchange.learnt

    async def _take(self, timeout: float | None) -> None:
        """Read one message."""
        try:
            async with asyncio.timeout(timeout):
                message = await self._open().recv()
        except TimeoutError as error:
            assert timeout is not None
            raise unanswered(timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
        self._exchange.take(message)

    def _open(self) -> awaited.ClientConnection:
        if self._connection is None:
            raise StreamError("the stream is not open: use `async with`", "closed")
        return self._connection


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
