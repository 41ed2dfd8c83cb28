"""A small application behind the real server, in a thread, to test connections and signals without a service."""

import asyncio
import json
import socket
import threading
from collections import deque
from contextlib import suppress
from typing import Any, Self

import uvicorn
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from service.api.limits.requests import PATIENCE, ClientPatience
from service.api.server.connections import guarded
from service.api.server.sockets import DRAIN_S, Server
from service.foundation.settings import Settings
from service.telemetry.readiness import StopState
from tests.service.data import DEADLINE, eventually
from tests.service.server import free_port


class SmallApp:
    """Answers `hello`; /large: many bytes; /body: the size of the body; /held: waits for `go`. Echoes streams.

    begun: number of requests so far; asking: number of unanswered requests; headers: of the last two requests; go:
    set to answer the waiting requests.
    """

    def __init__(self) -> None:
        self.begun = self.asking = 0
        self.headers: deque[list[tuple[bytes, bytes]]] = deque(maxlen=2)
        self.go = asyncio.Event()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            stream = WebSocket(scope, receive, send)
            await stream.accept()
            async for data in stream.iter_bytes():
                await stream.send_bytes(data)
            return
        self.begun += 1
        self.asking += 1
        try:
            await self._answer(scope, receive, send)
        finally:
            self.asking -= 1

    async def _answer(self, scope: Any, receive: Any, send: Any) -> None:
        content = b"hello"
        self.headers.append(scope["headers"])
        if scope["path"] == "/large":
            content = bytes(64 * 1024 * 1024)
        elif scope["path"].endswith("/body"):
            content = str(len(await Request(scope, receive).body())).encode()
        elif scope["path"] == "/held":
            await self.go.wait()
        await Response(content)(scope, receive, send)


class Serving:
    """The server with limits, running during a `with` block.

    with_app: its application; unix: a listening Unix-domain socket instead of a port.
    """

    def __init__(
        self,
        notice_s: float = 0.0,
        drain_s: int = DRAIN_S,
        patience: ClientPatience = PATIENCE,
        with_app: Any = None,
        unix: socket.socket | None = None,
        **limits: Any,
    ) -> None:
        self.app: Any = with_app or SmallApp()
        self.stopping, self.port = StopState(), free_port()
        settings = Settings(**limits)
        config = uvicorn.Config(
            self.app,
            port=self.port,
            http=guarded(settings, patience),
            lifespan="off",
            log_level="critical",
            timeout_keep_alive=settings.keep_alive_s,
            timeout_graceful_shutdown=drain_s,
            server_header=False,
            date_header=False,
        )
        self.server = Server(config, None, self.stopping, notice_s)
        sockets = None if unix is None else [unix]
        self.thread = threading.Thread(target=self.server.run, args=(sockets,), daemon=True)

    def connect(self, data: bytes = b"") -> "RawConnection":
        """Return a new connection on which these bytes were sent."""
        client = RawConnection(self.port)
        client.send(data)
        return client

    def ask(self, request: bytes) -> tuple[int, bytes]:
        """Return status and content of the answer on a connection of its own."""
        with self.connect(request) as client:
            return client.read_answer()

    def refusal(self, request: bytes) -> tuple[int, str, str]:
        """Return status, code and message of an error after which the server closes the connection."""
        with self.connect(request) as client:
            return error_of(client.read_to_end())

    @property
    def connections(self) -> int:
        """Return the number of open connections."""
        return len(self.server.server_state.connections)

    def __enter__(self) -> Self:
        self.thread.start()
        eventually(lambda: self.server.started)
        return self

    def __exit__(self, *_: object) -> None:
        self.server.should_exit = True
        self.thread.join(DEADLINE)
        assert not self.thread.is_alive()


class RawConnection:
    """A connection on which a test sends single bytes."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), DEADLINE)
        self.ahead = b""  # bytes of the next answer

    @classmethod
    def of(cls, connected: socket.socket) -> "RawConnection":
        """Return a connection over a socket."""
        made = cls.__new__(cls)
        made.socket, made.ahead = connected, b""
        return made

    def send(self, data: bytes) -> None:
        """Send bytes."""
        self.socket.sendall(data)

    def ask(self, request: bytes) -> tuple[int, bytes]:
        """Return status and content of the answer to a request."""
        self.send(request)
        return self.read_answer()

    def read_to_end(self) -> bytes:
        """Return all bytes until the server closes; empty if it sends none."""
        received = bytearray()
        with suppress(ConnectionError):
            while piece := self.socket.recv(1 << 16):
                received += piece
        return bytes(received)

    def read_exactly(self, size: int) -> bytes:
        """Return this number of bytes."""
        received = bytearray()
        while len(received) < size:
            received += self._some(size - len(received))
        return bytes(received)

    def read_answer(self) -> tuple[int, bytes]:
        """Return status and content of the next answer, which has a content length."""
        received = self.ahead
        while b"\r\n\r\n" not in received:
            received += self._some()
        head, _, content = received.partition(b"\r\n\r\n")
        length = next(int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
        while len(content) < length:
            content += self._some()
        self.ahead = content[length:]
        return int(head.split()[1]), content[:length]

    def _some(self, max_bytes: int = 1 << 16) -> bytes:
        piece = self.socket.recv(max_bytes)
        assert piece, "closed"
        return piece

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def error_of(answer: bytes) -> tuple[int, str, str]:
    """Return status, code and message of an error response."""
    head, _, content = answer.partition(b"\r\n\r\n")
    assert b"connection: close" in head.lower()
    error = json.loads(content)["error"]
    return int(head.split()[1]), error["code"], error["message"]
