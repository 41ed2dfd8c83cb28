"""Asynchronous client of torque streams."""

from __future__ import annotations

import asyncio
from time import monotonic
from typing import Any, Self, cast
from warnings import warn

from numpy.typing import ArrayLike
from websockets.asyncio import client as awaited
from websockets.exceptions import ConnectionClosed

from lipserve.answers import StreamAnswer, StreamError, StreamLearnt, StreamPart, StreamReply
from lipserve.exchange import closed, unanswered, unsettled
from lipserve.frames import ASK_CORIOLIS, ASK_GRAVITY, ASK_MASS_MATRIX, ASK_STD
from lipserve.stream_side import ASK_WARNING, StreamSide


class AsyncStreamClient(StreamSide):
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
        return cast("StreamAnswer", await self._wait(0, sequence, deadline, end))

    async def gravity(self, q: ArrayLike, std: bool = True, deadline: float = 0.0) -> StreamPart:
        """Return the torque that holds the arm against gravity; see `StreamClient.gravity`."""
        return await self._part(ASK_GRAVITY, deadline, ASK_STD if std else 0, q)

    async def mass_matrix(self, q: ArrayLike, deadline: float = 0.0) -> StreamPart:
        """Return the mass matrix; see `StreamClient.mass_matrix`."""
        return await self._part(ASK_MASS_MATRIX, deadline, 0, q)

    async def coriolis(self, q: ArrayLike, dq: ArrayLike, deadline: float = 0.0) -> StreamPart:
        """Return the Coriolis and centrifugal torque; see `StreamClient.coriolis`."""
        return await self._part(ASK_CORIOLIS, deadline, 0, q, dq)

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
        return await self._send(*self._exchange.frame(q, dq, ddq, std, deadline, tau, external, learn))

    async def receive(self) -> StreamAnswer:
        """Return the answer to the oldest open query; raise StreamError if the query was rejected."""
        while (answer := self._exchange.answer()) is None:
            await self._receive(self.timeout)
        return answer

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

    async def _part(self, kind: int, deadline: float, more: int, *vectors: ArrayLike) -> StreamPart:
        end = self._until(deadline)
        sequence = await self._send(*self._exchange.part_frame(kind | more, deadline, *vectors))
        return cast("StreamPart", await self._wait(kind, sequence, deadline, end))

    async def _send(self, sequence: int, frame: bytes) -> int:
        try:
            await self._open().send(frame)
        except ConnectionClosed as error:
            raise closed(error) from error
        return sequence

    async def _wait(self, kind: int, sequence: int, deadline: float, end: float) -> StreamReply:
        """Return the answer to a query, or the last one of its kind; see `StreamClient`."""
        while (reply := self._answer_to(sequence)) is None:
            try:
                await self._receive(max(0.0, end - monotonic()))
            except StreamError as error:
                return self._late(kind, sequence, deadline, error)
        return self._in_time(kind, reply)

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
