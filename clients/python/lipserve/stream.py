"""Synchronous and asynchronous clients of torque streams, for controllers on the same host or network."""

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
from lipserve.call import split_name
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
"""Min timeout for opening and flushing a stream, s; a control loop's `timeout` may be shorter."""
ASK_WARNING = "{0}.ask is deprecated since 0.3 and will be removed in 0.4. Use {0}.predict."


class _Stream(StreamSide):
    """Common part of both stream clients. Arguments: see `StreamClient`."""

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
        rich: bool = False,
        without_gravity: bool = False,
    ) -> None:
        headers = headers_of(key)
        address = Address.of(url_of(url))
        self.timeout, self._url = timeout, address.base
        self._unix = address.unix if unix is None else Path(unix)
        self._exchange = Exchange(stream_id, first_sequence)
        model, which = split_name(model, version, alias)
        query = {**which, "stream_id": stream_id}
        flags = {"scale": scale, "payload": payload, "rich": rich, "without_gravity": without_gravity}
        query |= {name: 1 if wanted else None for name, wanted in flags.items()}
        self._destination = destination(address.base, model, **query)
        self._options: dict[str, Any] = {
            "compression": None,
            "open_timeout": self._patience,
            "close_timeout": 1.0,
            "additional_headers": headers,
        }
        self._begin()

    @property
    def _patience(self) -> float:
        """Max time to wait for a connection and for acknowledgements, s."""
        return max(PATIENCE_S, self.timeout)

    def _begin(self) -> None:
        """Open the stream, if the constructor of the client does so."""

    @contextmanager
    def _opening(self) -> Iterator[None]:
        """Convert connection errors in the block to StreamError."""
        try:
            yield
        except InvalidStatus as error:
            raise refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {self._unix or self._url}: {error}", "unreachable") from error

    _last: StreamAnswer | None = None  # last answer in time

    def _until(self, deadline: float) -> float:
        """Return when to stop waiting for an answer, by `monotonic`."""
        return monotonic() + (deadline or self.timeout)

    def _in_time(self, answer: StreamAnswer) -> StreamAnswer:
        """Return the answer, or the last one in time if it is late."""
        if not answer.late:
            self._last = answer
            return answer
        return answer if self._last is None else self._last_marked_late()

    def _late(self, sequence: int, deadline: float, error: StreamError) -> StreamAnswer:
        """Return the last answer in time, instead of one that missed its deadline; raise StreamError without one."""
        if error.code != "timeout":
            raise error
        self._exchange.given_up(sequence)
        if not deadline or self._last is None:
            raise unanswered(deadline or self.timeout) from error
        return self._last_marked_late()

    def _last_marked_late(self) -> StreamAnswer:
        assert self._last is not None
        return replace(self._last, late=True, late_answers=self._exchange.late_answers)

    def _answer_to(self, sequence: int) -> StreamAnswer | None:
        """Return the answer to a query if it has arrived, dropping earlier ones; raise StreamError if rejected."""
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
    """Synchronous torque stream. Use it as a context manager, or close it. Do not share it between threads.

    Args:
        model: Name of the model.
        url: As in `Client`.
        unix: Path of the service's Unix-domain socket, instead of host and port.
        version: Version number. Default: the serving version, also if it changes.
        timeout: Max time to wait for an answer without a deadline, s.
        stream_id: Name of the robot or recording, to let the model learn from sent torques. Default: do not learn.
        first_sequence: Sequence of the first frame. To send torques again after a lost connection, start with the
            first sequence above that of `learnt`.
        alias: Alias of the version, instead of its number; followed if it moves.
        key: As in `Client`.
        scale: Request the factor on the half width of intervals with every answer.
        payload: Request the estimated payload with every answer.
        rich: Answer from all centres of a correction (`rigid-body+local`), which takes longer.
        without_gravity: Return torques minus gravity, with the standard deviation of the difference, for robots that
            add gravity.

    Raises:
        StreamError: The service cannot be reached or refuses the stream.

    Example:
        >>> with StreamClient("panda-sim") as stream:
        ...     answer = stream.predict([0.0] * 7, [0.0] * 7, [0.0] * 7)
        >>> answer.tau.shape
        (7,)
    """

    def _begin(self) -> None:
        self._stack = ExitStack()
        address, host, port = self._destination
        with self._opening():
            made = _connect(host, port, self._unix, self._patience)
            self._socket = self._stack.enter_context(connect(address, sock=made, **self._options))
        self._receive(self._patience)

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
        """Predict the torque at one motion.

        If the deadline passes, the call returns the last answer that came in time, marked as `late` and with its own
        sequence. The next call drops the answer that arrives too late.

        Args:
            q: (n,) positions, rad (prismatic: m).
            dq: (n,) velocities, rad/s.
            ddq: (n,) accelerations, rad/s².
            std: Request the standard deviation.
            deadline: Max time for this call, s; 0: wait for `timeout`.
            tau: (n,) torque measured at this motion, N·m. The model learns from it after the answer, if the client
                has a stream_id and learn is True.
            external: Request the external torque, i.e. the part of tau that the model does not explain.
            learn: Whether the model may learn from tau.

        Returns:
            The answer.

        Raises:
            ValueError: The arguments have wrong shapes or do not fit together.
            StreamError: The service rejects the motion (the stream stays open), is not reachable, or does not answer
                in time (code `timeout`) and no earlier answer came in time.
        """
        end = self._until(deadline)
        sequence = self.send(q, dq, ddq, std, deadline, tau, external, learn)
        while (answer := self._answer_to(sequence)) is None:
            try:
                self._receive(max(0.0, end - monotonic()))
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
        """Send a query and return its sequence. Arguments: see `predict`; `receive` returns the answer."""
        sequence, frame = self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn)
        try:
            self._socket.send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    def receive(self) -> StreamAnswer:
        """Return the answer to the oldest open query; raise StreamError if the query was rejected."""
        while not self._exchange.answers:
            self._receive(self.timeout)
        return self._exchange.answer()

    def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until all sent torques are acknowledged or refused, and return the totals.

        Answers that arrive meanwhile are kept for `receive`.

        Args:
            timeout: Max time to wait, s. Default: 10 s, or the client's timeout if that is longer.

        Raises:
            StreamError: It takes longer, or the service is not reachable.
        """
        timeout = self._patience if timeout is None else timeout
        end = monotonic() + timeout
        while self._exchange.unsettled:
            try:
                self._receive(max(end - monotonic(), 0.0))
            except StreamError as error:
                if error.code != "timeout":
                    raise
                raise unsettled(len(self._exchange.unsettled), timeout) from error
        return self._exchange.learnt

    def _receive(self, timeout: float) -> None:
        """Receive and process one message."""
        try:
            message = self._socket.recv(timeout)
        except TimeoutError as error:
            raise unanswered(timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
        try:
            self._exchange.receive(message)
        except StreamError:  # unsupported frame layout
            self.close()
            raise


class AsyncStreamClient(_Stream):
    """Asynchronous torque stream; open it with `async with`. Do not share it between tasks.

    Arguments, methods and errors are those of `StreamClient`; methods that wait are awaited.

    Example:
        >>> async def torque():
        ...     async with AsyncStreamClient("panda-sim") as stream:
        ...         return await stream.predict([0.0] * 7, [0.0] * 7, [0.0] * 7)
    """

    _connection: awaited.ClientConnection | None = None

    async def __aenter__(self) -> Self:
        address = self._destination.address
        with self._opening():
            if self._unix is None:
                # ignore proxy settings of the environment: they are not meant for controllers
                self._connection = await awaited.connect(address, proxy=None, **self._options)
            else:
                self._connection = await awaited.unix_connect(str(self._unix), address, **self._options)
        try:
            await self._receive(self._patience)
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
        """Predict the torque at one motion; see `StreamClient.predict`.

        If the task is cancelled, the next call drops the answer.
        """
        end = self._until(deadline)
        sequence = await self.send(q, dq, ddq, std, deadline, tau, external, learn)
        while (answer := self._answer_to(sequence)) is None:
            try:
                await self._receive(max(0.0, end - monotonic()))
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
        """Send a query and return its sequence. Arguments: see `predict`; `receive` returns the answer."""
        sequence, frame = self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn)
        try:
            await self._open().send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    async def receive(self) -> StreamAnswer:
        """Return the answer to the oldest open query; raise StreamError if the query was rejected."""
        while not self._exchange.answers:
            await self._receive(self.timeout)
        return self._exchange.answer()

    async def flush(self, timeout: float | None = None) -> StreamLearnt:
        """Wait until all sent torques are acknowledged or refused; see `StreamClient.flush`."""
        timeout = self._patience if timeout is None else timeout
        try:
            async with asyncio.timeout(timeout):
                while self._exchange.unsettled:
                    await self._receive(None)
        except TimeoutError as error:
            raise unsettled(len(self._exchange.unsettled), timeout) from error
        return self._exchange.learnt

    async def _receive(self, timeout: float | None) -> None:
        """Receive and process one message."""
        try:
            async with asyncio.timeout(timeout):
                message = await self._open().recv()
        except TimeoutError as error:
            assert timeout is not None
            raise unanswered(timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
        self._exchange.receive(message)

    def _open(self) -> awaited.ClientConnection:
        if self._connection is None:
            raise StreamError("the stream is not open: use `async with`", "closed")
        return self._connection


def _connect(host: str, port: int, unix: Path | None, timeout: float) -> socket.socket:
    """Open a connection without Nagle's delay; ignore proxy settings of the environment."""
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
