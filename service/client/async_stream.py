"""An asynchronous client of torque streams: that of `stream`, awaited."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import TracebackType
from typing import Self

from numpy.typing import ArrayLike
from websockets.asyncio.client import ClientConnection, connect, unix_connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from service.client.sending import headers_of
from service.foundation.settings import DEFAULT_URL
from service.stream.exchange import (
    Exchange,
    StreamAnswer,
    StreamError,
    StreamLearnt,
    StreamSide,
    closed,
    destination,
    refused,
    unanswered,
    unsettled,
)


class AsyncStreamClient(StreamSide):
    """One stream, open while `async with` lasts. Not to be shared between tasks.

    Arguments, methods and errors are those of `StreamClient`; methods that wait are awaited.
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
        self.timeout = timeout
        self._where, self._unix, self._headers = unix or url, unix, headers_of(key)
        self._exchange = Exchange(stream_id, first_sequence)
        self._address, _, _ = destination(url, model, version=version, alias=alias, stream_id=stream_id)
        self._connection: ClientConnection | None = None

    async def __aenter__(self) -> Self:
        how = {
            "compression": None,
            "open_timeout": self.timeout,
            "close_timeout": 1.0,
            "additional_headers": self._headers,
        }
        try:
            if self._unix is None:
                # the proxy that an environment may name is not for controllers
                self._connection = await connect(self._address, proxy=None, **how)  # type: ignore[arg-type]
            else:
                self._connection = await unix_connect(str(self._unix), self._address, **how)
        except InvalidStatus as error:
            raise refused(error.response.status_code, error.response.body) from error
        except (OSError, InvalidHandshake) as error:
            raise StreamError(f"no service answers at {self._where}: {error}", "unreachable") from error
        try:
            await self._take(self.timeout)
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            await self._connection.close()

    async def ask(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
    ) -> StreamAnswer:
        """Return the torque at one motion; see `StreamClient.ask`. Where the task is cancelled meanwhile, the answer is
        dropped by the next call."""
        sequence = await self.send(q, dq, ddq, std, deadline, tau)
        while True:
            try:
                answer = await self.receive()
            except StreamError as error:
                if error.sequence is None or error.sequence == sequence:
                    raise
                continue
            if answer.sequence == sequence:
                return answer

    async def send(
        self,
        q: ArrayLike,
        dq: ArrayLike,
        ddq: ArrayLike,
        std: bool = True,
        deadline: float = 0.0,
        tau: ArrayLike | None = None,
    ) -> int:
        """Send one query, with torque to learn from or without, and return its sequence; `receive` has its answer."""
        sequence, frame = self._exchange.frame(q, dq, ddq, std, deadline, tau)
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
        timeout = self.timeout if timeout is None else timeout
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

    def _open(self) -> ClientConnection:
        if self._connection is None:
            raise StreamError("the stream is not open: use `async with`", "closed")
        return self._connection
