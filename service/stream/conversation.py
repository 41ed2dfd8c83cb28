"""One WebSocket connection: a message in, a message out, in order, and an end to clients that are gone."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from time import perf_counter

from starlette.types import Message, Receive, Send

from service.foundation.settings import Settings
from service.web.access.middleware import subprotocol_of
from service.web.server.connections import StreamProtocol


class Conversation(ABC):
    """Answers messages one by one, reading the next when the answer is written.

    ASGI's own calls rather than Starlette's WebSocket: that costs 3 µs a message, 1 µs as here.
    left: when the last answer had been written, in seconds of `time.perf_counter`.
    """

    def __init__(self, connection: StreamProtocol, receive: Receive, send: Send, settings: Settings) -> None:
        self.connection, self.receive, self.send, self.settings = connection, receive, send, settings
        self.left = perf_counter()
        self._writing = False
        self._texts: deque[str] = deque()
        self._closing: asyncio.Task[None] | None = None

    @abstractmethod
    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the answer to a message that arrived at a time of `time.perf_counter`."""

    async def greet(self) -> None:
        """Say what a client has to know before it asks."""
        return

    async def run(self) -> None:
        """Accept the connection and talk until either side ends it."""
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
                self.left = perf_counter()  # since when the answer waits, should it have to
                await send({"type": "websocket.send", "bytes": answer})
                self.left = perf_counter()
                if self._texts:
                    await self._say()
                self._writing = False
                # neither call above lets others run when messages wait: a client that sends many must not hold up all
                await asyncio.sleep(0)
        finally:
            self._timer.cancel()

    async def say(self, text: str) -> None:
        """Send a text between answers: now, or after the answer that is being written. One caller at a time.

        A client that does not read it is cut off as one that does not read its answers; one that is gone misses it.
        """
        self._texts.append(text)
        if self._writing:
            return
        with suppress(OSError, RuntimeError):  # gone, or closing, which uvicorn says in its own way
            try:
                async with asyncio.timeout(self.settings.stream_write_s):
                    await self._say()
            except TimeoutError:
                self.connection.abort()

    async def _say(self) -> None:
        while self._texts:
            await self.send({"type": "websocket.send", "text": self._texts.popleft()})

    def _watch(self) -> None:
        period = min(self.settings.stream_idle_s, self.settings.stream_write_s)
        self._timer = asyncio.get_running_loop().call_later(period, self._look)

    def _look(self) -> None:
        """End a connection that is idle or does not read. Looked at now and then: a timer a frame costs time."""
        waited = perf_counter() - self.left
        if self._writing and waited >= self.settings.stream_write_s:
            self.connection.abort()
        elif not self._writing and waited >= self.settings.stream_idle_s:
            self._closing = asyncio.get_running_loop().create_task(self._close_idle())
        else:
            self._watch()

    async def _close_idle(self) -> None:
        reason = f"no frame for {self.settings.stream_idle_s:g} s (LIPSERVE_STREAM_IDLE_S)"
        with suppress(OSError):  # gone already
            await self.send({"type": "websocket.close", "code": 1000, "reason": reason})


class Echo(Conversation):
    """Sends back what comes: the floor that answers are compared with."""

    async def reply(self, message: Message, arrived: float) -> bytes:
        """Return the message itself."""
        text = message.get("text")
        data: bytes = message["bytes"] if text is None else text.encode()
        return data
