"""Conversations over one WebSocket connection, and the echo."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from time import perf_counter

from starlette.types import Message, Receive, Send

from service.api.access.middleware import subprotocol_of
from service.api.limits.requests import PATIENCE
from service.api.server.streams import StreamProtocol
from service.foundation.settings import Settings


class Conversation(ABC):
    """Answers messages in order, one at a time, and closes idle or unresponsive connections.

    It uses ASGI directly: 1 µs per message, instead of 3 µs with Starlette's WebSocket. `left` is the time when the
    last answer was written, in seconds of `time.perf_counter`.
    """

    def __init__(self, connection: StreamProtocol, receive: Receive, send: Send, settings: Settings) -> None:
        self.connection, self.receive, self.send, self.settings = connection, receive, send, settings
        self.left = perf_counter()
        self._writing = False
        self._texts: deque[str] = deque()
        self._closing: asyncio.Task[None] | None = None

    @abstractmethod
    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the answer to a message; `arrived` is a time of `time.perf_counter`."""

    async def greet(self) -> None:
        """Send what a client needs before its first message."""
        return

    async def run(self) -> None:
        """Accept the connection and answer messages until either side closes it."""
        receive, send, connection, reply = self.receive, self.send, self.connection, self.reply
        await receive()
        await send({"type": "websocket.accept", "subprotocol": subprotocol_of(connection.scope["subprotocols"])})
        await self.greet()
        self._watch()
        try:
            while True:
                message = await receive()
                arrived = connection.arrived
                if message["type"] == "websocket.disconnect":
                    return
                answer = await reply(message, arrived)
                self._writing = True
                self.left = perf_counter()  # start of a possible wait for the client to read
                await send({"type": "websocket.send", "bytes": answer})
                self.left = perf_counter()
                if self._texts:
                    await self._write_texts()
                self._writing = False
                # with waiting messages, no call above yields to other tasks: a fast client must not block them
                await asyncio.sleep(0)
        finally:
            self._timer.cancel()

    async def send_text(self, text: str) -> None:
        """Send a text now or after the answer that is being written. Only one caller at a time.

        The connection of a client that does not read it is aborted. Nothing happens if the client has disconnected.
        """
        self._texts.append(text)
        if self._writing:
            return
        with suppress(OSError, RuntimeError):  # disconnected, or closing: uvicorn's RuntimeError
            try:
                async with asyncio.timeout(PATIENCE.frame_s):
                    await self._write_texts()
            except TimeoutError:
                self.connection.abort()

    async def _write_texts(self) -> None:
        while self._texts:
            await self.send({"type": "websocket.send", "text": self._texts.popleft()})

    def _watch(self) -> None:
        period = min(self.settings.stream_idle_s, PATIENCE.frame_s)
        self._timer = asyncio.get_running_loop().call_later(period, self._check_timeouts)

    def _check_timeouts(self) -> None:
        """Close a connection that is idle or does not read. A periodic check is cheaper than one timer per frame."""
        waited = perf_counter() - self.left
        if self._writing and waited >= PATIENCE.frame_s:
            self.connection.abort()
        elif not self._writing and waited >= self.settings.stream_idle_s:
            self._closing = asyncio.get_running_loop().create_task(self._close_idle())
        else:
            self._watch()

    async def _close_idle(self) -> None:
        reason = f"no frame for {self.settings.stream_idle_s:g} s (LIPSERVE_STREAM_IDLE_S)"
        with suppress(OSError):  # already disconnected
            await self.send({"type": "websocket.close", "code": 1000, "reason": reason})


class Echo(Conversation):
    """Returns every message unchanged, to measure latency without computation."""

    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the message itself."""
        text = message.get("text")
        data: bytes = message["bytes"] if text is None else text.encode()
        return data
