"""Minimal HTTP client: one open connection, prepared requests, responses read by their content-length.

httpx costs 0.4 ms a call, more than the service's answer.
"""

from __future__ import annotations

import socket
from pathlib import Path
from types import TracebackType
from typing import Self

Address = tuple[str, int] | Path
"""Host and port, or the path of a Unix-domain socket."""

TIMEOUT = 60.0
_CHUNK = 1 << 18
_END, _LENGTH = b"\r\n\r\n", b"content-length:"


class BadAnswerError(RuntimeError):
    """The service answered a query of the benchmark with an error."""


def connect(address: Address) -> socket.socket:
    """Open a connection without Nagle's delay."""
    if isinstance(address, Path):
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(TIMEOUT)
        connection.connect(str(address))
        return connection
    connection = socket.create_connection(address, timeout=TIMEOUT)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def post(path: str, body: bytes, media_type: str = "application/json", headers: dict[str, str] | None = None) -> bytes:
    """Return the bytes of a POST request."""
    lines = [
        f"POST {path} HTTP/1.1",
        "host: localhost",
        f"content-type: {media_type}",
        f"content-length: {len(body)}",
        *(f"{name}: {value}" for name, value in (headers or {}).items()),
    ]
    return "\r\n".join(lines).encode() + _END + body


def get(path: str, headers: dict[str, str] | None = None) -> bytes:
    """Return the bytes of a GET request."""
    lines = [
        f"GET {path} HTTP/1.1",
        "host: localhost",
        *(f"{name}: {value}" for name, value in (headers or {}).items()),
    ]
    return "\r\n".join(lines).encode() + _END


class GoneError(BadAnswerError):
    """The service closed the connection."""


class Connection:
    """An open connection that is read in large chunks; a context manager."""

    _socket: socket.socket

    def _more(self) -> bytes:
        part = self._socket.recv(_CHUNK)
        if not part:
            raise GoneError("The service closed the connection.")
        return part

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class HttpClient(Connection):
    """A client that sends one request at a time and reconnects after the service has closed an idle connection."""

    def __init__(self, address: Address) -> None:
        self._address, self._socket = address, connect(address)

    def ask(self, request: bytes) -> bytes:
        """Send a request and return the body of its answer; raise BadAnswerError unless it is 200."""
        return self.exchange(request)[1]

    def exchange(self, request: bytes) -> tuple[bytes, bytes]:
        """Send a request and return head and body of its answer; raise BadAnswerError unless it is 200."""
        data = self._send(request)
        if not data:
            self._socket.close()
            self._socket = connect(self._address)
            data = self._send(request) or self._more()
        while (end := data.find(_END)) < 0:
            data += self._more()
        head = data[:end].lower()
        at = head.find(_LENGTH)
        if at < 0:
            raise BadAnswerError(f"The response has no content-length: {head.decode(errors='replace')}")
        stop = head.find(b"\r\n", at)
        length = int(head[at + len(_LENGTH) : stop if stop > 0 else end])
        missing = end + len(_END) + length - len(data)
        if missing > 0:
            parts = [data]
            while missing > 0:
                part = self._more()
                parts.append(part)
                missing -= len(part)
            data = b"".join(parts)
        body = data[end + len(_END) :]
        if not head.startswith(b"http/1.1 200"):
            raise BadAnswerError(
                f"{head.splitlines()[0].decode(errors='replace')}: {body[:500].decode(errors='replace')}"
            )
        return head, body

    def _send(self, request: bytes) -> bytes:
        """Send a request and return the first bytes of its response; b"" if the connection was closed."""
        try:
            self._socket.sendall(request)
            return self._socket.recv(_CHUNK)
        except ConnectionError:
            return b""
