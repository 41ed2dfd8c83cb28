"""A small application behind the real server, in a thread: connections and signals without a service."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from contextlib import suppress
from typing import Any, Self

import uvicorn

from service.foundation.settings import Settings
from service.web.observability.readiness import Stopping
from service.web.server.connections import guarded
from service.web.server.sockets import Server
from tests.service.data import DEADLINE, eventually
from tests.service.server import free_port


class SmallApp:
    """Answers `hello`; /large: many bytes; /body: the size of the body; /held: once it may; /unread: reads no body.

    begun: how many requests have come; go: lets those that are held go on.
    """

    def __init__(self) -> None:
        self.begun = 0
        self.go = asyncio.Event()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await _echo(receive, send)
        if scope["type"] != "http":
            return
        self.begun += 1
        content = b"hello"
        if scope["path"] == "/large":
            content = bytes(64 * 1024 * 1024)
        elif scope["path"] == "/body":
            size, more = 0, True
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return
                size, more = size + len(message["body"]), message["more_body"]
            content = str(size).encode()
        elif scope["path"] == "/held":
            await self.go.wait()
        headers = [(b"content-length", str(len(content)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})


async def _echo(receive: Any, send: Any) -> None:
    """Say again what comes over a WebSocket."""
    await receive()
    await send({"type": "websocket.accept"})
    while (message := await receive())["type"] == "websocket.receive":
        await send({"type": "websocket.send", "bytes": message["bytes"]})


class Serving:
    """The server with limits, while the block lasts."""

    def __init__(self, notice_s: float = 0.0, **limits: Any) -> None:
        self.app, self.stopping, self.port = SmallApp(), Stopping(), free_port()
        settings = Settings(**limits)
        config = uvicorn.Config(
            self.app,
            port=self.port,
            http=guarded(settings),
            lifespan="off",
            log_level="critical",
            timeout_keep_alive=settings.keep_alive_s,
            timeout_graceful_shutdown=settings.drain_s,
        )
        self.server = Server(config, None, self.stopping, notice_s)
        self.thread = threading.Thread(target=self.server.run, daemon=True)

    @property
    def connections(self) -> int:
        """How many connections the server has."""
        return len(self.server.server_state.connections)

    def __enter__(self) -> Self:
        self.thread.start()
        eventually(lambda: self.server.started)
        return self

    def __exit__(self, *_: object) -> None:
        self.server.should_exit = True
        self.thread.join(DEADLINE)
        assert not self.thread.is_alive()


class Raw:
    """A connection that says what it is told to, byte for byte."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), DEADLINE)
        self.ahead = b""  # of the next answer

    def send(self, data: bytes) -> None:
        """Send bytes."""
        self.socket.sendall(data)

    def rest(self) -> bytes:
        """All that comes until the other side closes, empty where it says nothing."""
        found = bytearray()
        with suppress(ConnectionError):
            while piece := self.socket.recv(1 << 16):
                found += piece
        return bytes(found)

    def exactly(self, size: int) -> bytes:
        """The next bytes, as many as that."""
        found = bytearray()
        while len(found) < size:
            found += self._some(size - len(found))
        return bytes(found)

    def answer(self) -> tuple[int, bytes]:
        """Status and content of the next answer, whose length is announced."""
        found = self.ahead
        while b"\r\n\r\n" not in found:
            found += self._some()
        head, _, content = found.partition(b"\r\n\r\n")
        length = next(int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        while len(content) < length:
            content += self._some()
        self.ahead = content[length:]
        return int(head.split()[1]), content[:length]

    def _some(self, most: int = 1 << 16) -> bytes:
        piece = self.socket.recv(most)
        assert piece, "closed"
        return piece

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def refusal(answer: bytes) -> tuple[int, str, str]:
    """Status, code and message of an answer that is an error."""
    head, _, content = answer.partition(b"\r\n\r\n")
    assert b"connection: close" in head.lower()
    error = json.loads(content)["error"]
    return int(head.split()[1]), error["code"], error["message"]
