"""Connections that pass from one plane to the other between two requests, with the bytes already read.

The data plane answers a connection as long as each request is a whole small query of a control loop. Any other request
passes the connection on to the control plane, which can answer every route. The control plane passes it back at the
next query.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import socket
from collections.abc import Callable
from typing import Any, ClassVar, Literal

from service.api.server.connections import GuardedProtocol
from service.foundation.errors import ErrorBody, ErrorResponse

MAX_QUERY_BYTES = 16 * 1024
"""Max size of a request that the data plane answers, with its headers."""
_QUERY = re.compile(
    rb"(?:POST /v1/(?:models/[^/ ?]+/predict|echo)|GET /health/live|"
    rb"GET /v1/(?:models/[^/ ?]+|echo)/stream(?:\?[^ ]*)?) HTTP/1\.1\r\n"
)
_LENGTH = re.compile(rb"\r\ncontent-length:[ \t]*(\d+)[ \t]*\r\n", re.IGNORECASE)
_ELSE = re.compile(rb"\r\n(?:transfer-encoding|expect|content-encoding):", re.IGNORECASE)
PROTOCOL, RAW = "lipserve.protocol", "lipserve.raw"
"""Keys of a scope: the connection of a request; in its state, the bytes of the request of a stream."""

PassOn = Callable[[int, bytes], bool]
"""Passes a connection on: its file descriptor, which stays open here, and the bytes read. Returns whether it did."""


def judge(data: bytes) -> Literal["whole", "part", "other"]:
    """Return whether the bytes at the start of a request are one whole query, the start of one, or anything else."""
    end = data.find(b"\r\n\r\n")
    if len(data) > MAX_QUERY_BYTES:
        return "other"
    if end < 0:
        return "part" if data.startswith((b"POST /v1/", b"GET /v1/models/", b"GET /v1/echo/")) else "other"
    head = data[: end + 4]
    if not _QUERY.match(head) or _ELSE.search(head):
        return "other"
    length = _LENGTH.search(head)
    left = end + 4 + (0 if length is None else int(length[1])) - len(data)
    return "whole" if left == 0 else "part" if left > 0 else "other"


def pass_on(transport: asyncio.Transport, data: bytes, send: PassOn) -> bool:
    """Pass a connection on and end it here; return False if the other plane does not take it."""
    transport.pause_reading()
    copy = os.dup(transport.get_extra_info("socket").fileno())
    try:
        sent = send(copy, data)
    finally:
        os.close(copy)
    if sent:
        transport.abort()  # closes our descriptor only: the connection lives on in the other process
    return sent


class DataProtocol(GuardedProtocol):
    """A connection in the data plane."""

    send: ClassVar[PassOn]
    first: bytes = b""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.raw = b""
        self._part = self._later = b""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, with the bytes that the control plane has read, if any."""
        super().connection_made(transport)
        if self.first:
            self.data_received(self.first)

    def data_received(self, data: bytes) -> None:
        """Handle bytes: collect a whole query, or pass the connection on."""
        if self.cycle is not None and not self.cycle.response_complete:
            self._later += data  # the next request came before the answer
            self.transport.pause_reading()
            return
        data = self._part + data
        kind = judge(data)
        if kind == "part":
            self._part = data
            if self._head is None:
                self._head = self.loop.call_later(self.patience.header_s, self._late)
            return
        self._part, self.raw = b"", data
        if kind == "other":
            self.hand_over()
        else:
            super().data_received(data)

    def handle_websocket_upgrade(self) -> None:
        """Begin a stream, whose request may still be handed over."""
        self.app_state = {**self.app_state, RAW: self.raw}
        super().handle_websocket_upgrade()

    def on_message_begin(self) -> None:
        """Give the application a way to hand the request over."""
        super().on_message_begin()
        scope: Any = self.scope
        scope[PROTOCOL] = self

    def on_response_complete(self) -> None:
        """Handle a request that came before the answer."""
        super().on_response_complete()
        if self._later and not self.transport.is_closing():
            later, self._later = self._later, b""
            self.transport.resume_reading()
            self.loop.call_soon(self.data_received, later)

    def hand_over(self) -> None:
        """Let the control plane answer this request and those that follow."""
        if self.cycle is not None:
            self.cycle.disconnected = True
        if not pass_on(self.transport, self.raw + self._later, type(self).send):
            refuse_connection(self.transport)

    def _late(self) -> None:
        self._part = b""
        super()._late()


class ControlProtocol(GuardedProtocol):
    """A connection in the control plane, which came from the data plane."""

    send: ClassVar[PassOn]
    first: bytes = b""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin with the bytes that the data plane has read."""
        super().connection_made(transport)
        super().data_received(self.first)

    def data_received(self, data: bytes) -> None:
        """Handle bytes; pass the connection back at the start of a query."""
        idle = self.cycle is not None and self.cycle.response_complete and not self._upgraded and self._head is None
        if not (idle and judge(data) != "other" and pass_on(self.transport, data, type(self).send)):
            super().data_received(data)


def refuse_connection(transport: asyncio.Transport) -> None:
    """Answer that the control plane is gone."""
    error = ErrorBody(code="not_ready", message="The control plane of the service does not answer. Try again later.")
    content = json.dumps(ErrorResponse(error=error).model_dump()).encode()
    head = b"HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/json\r\nretry-after: 1\r\n"
    transport.write(head + b"connection: close\r\ncontent-length: %d\r\n\r\n" % len(content) + content)
    transport.close()


async def adopt(fd: int, protocol: Callable[[], asyncio.Protocol]) -> None:
    """Serve a connection that the other plane has passed on."""
    connection = socket.socket(fileno=fd)
    connection.setblocking(False)
    try:
        await asyncio.get_running_loop().connect_accepted_socket(protocol, connection)
    except OSError:  # the client is gone
        connection.close()
