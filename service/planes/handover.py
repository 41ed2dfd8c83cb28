"""Connections that pass from one plane to the other between two requests, with the bytes already read.

The data plane answers a connection as long as each request is a whole small query of a control loop. Any other request
passes the connection on to the control plane, which can answer every route. The control plane passes it back at the
next query.
"""

from __future__ import annotations

import asyncio
import os
import re
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pickle import PickleBuffer
from typing import Protocol

from service.api.errors import answer_of
from service.foundation.errors import NotReadyError
from service.runtime.channel import MIN_SHARED_BYTES

MAX_QUERY_BYTES = 16 * 1024
"""Max size of a request that the data plane answers, with its headers."""
PART, OTHER = 0, -1
"""Results of `find_query`: the rest of the query is missing; there is no query."""
_STARTS = (
    *(b"POST /v1/models/", b"POST /v1/echo ", b"POST /v2/models/"),
    *(b"GET /v1/models/", b"GET /v1/echo/stream", b"GET /health/live "),
)
_QUERY = re.compile(
    rb"(?:POST /v1/(?:models/[^/ ?]+/predict|echo)|POST /v2/models/[^/ ?]+(?:/versions/[^/ ?]+)?/infer|"
    rb"GET /health/live) HTTP/1\.1\r\n"
)
_STREAM = re.compile(rb"GET /v1/(?:models/[^/ ?]+|echo)/stream(?:\?[^ ]*)? HTTP/1\.1\r\n")
_HEADERS = re.compile(rb"(?:[!-9;-~]+:[^\x00-\x08\x0a-\x1f\x7f]*\r\n)*\r\n")
_LENGTH = re.compile(rb"\r\ncontent-length:([^\r]*)", re.IGNORECASE)
_NUMBER = re.compile(rb"[ \t]*(\d{1,9})[ \t]*")
_BODY = re.compile(rb"\r\n(?:transfer-encoding|content-length|content-encoding|expect):", re.IGNORECASE)
_ELSE = re.compile(rb"\r\n(?:transfer-encoding|content-encoding|expect|upgrade):", re.IGNORECASE)


def find_query(data: bytes) -> int:
    """Return the size of the whole query at the start of the data, else `PART` or `OTHER`.

    Only plain requests are queries: each header a line of its own, the body of a known length.
    """
    end = data.find(b"\r\n\r\n") + 4
    if end < 4:
        can_be = len(data) <= MAX_QUERY_BYTES and (data.startswith(_STARTS) or _starts_one(data))
        return PART if can_be and data.count(b"\n") == data.count(b"\r\n") else OTHER
    line = _QUERY.match(data, 0, end) or _STREAM.match(data, 0, end)
    if line is None or not _HEADERS.fullmatch(data, line.end(), end):
        return OTHER
    if line.re is _STREAM:
        return OTHER if _BODY.search(data, 0, end) else len(data)
    lengths = _LENGTH.findall(data, 0, end) or [b"0"]
    number = _NUMBER.fullmatch(lengths[0])
    if number is None or len(lengths) > 1 or _ELSE.search(data, 0, end):
        return OTHER
    size = end + int(number[1])
    if size > MAX_QUERY_BYTES:
        return OTHER
    return size if size <= len(data) else PART


def _starts_one(data: bytes) -> bool:
    return any(start.startswith(data) for start in _STARTS)


@dataclass(frozen=True)
class Handed:
    """A connection that one plane passes to the other, besides its file descriptor."""

    data: bytes | PickleBuffer
    """The bytes that were read and not answered."""
    counted: bool = False
    """Whether rate limits have counted the first request of these bytes."""
    refused: str = ""
    """Why all its requests are answered with 429, empty if they are not."""
    number: int = 0
    """Counts the connections that the data plane has passed on."""

    @property
    def read(self) -> bytes:
        """The bytes that were read and not answered."""
        return bytes(self.data)


class PassOn(Protocol):
    """Passes a connection to the other plane."""

    def __call__(self, transport: asyncio.Transport, handed: Handed, peer: str | None) -> bool:
        """Pass the connection of a client on and end it here; return False if the other plane does not take it.

        All bytes written must have left the transport. It never waits. peer: as in `LimitedConnection`.
        """
        ...


def pass_on(transport: asyncio.Transport, handed: Handed, send: Callable[[int, Handed], bool]) -> bool:
    """Pass a connection on, as in `PassOn`. send: sends a message with a file descriptor, which stays open here."""
    transport.pause_reading()
    copy = os.dup(transport.get_extra_info("socket").fileno())
    try:
        sent = send(copy, handed)
    finally:
        os.close(copy)
    if sent:
        transport.abort()  # closes our descriptor only: the connection lives on in the other process
    return sent


def shared(data: bytes) -> bytes | PickleBuffer:
    """Return bytes in the form in which a message carries them: many of them in shared memory."""
    return data if len(data) < MIN_SHARED_BYTES else PickleBuffer(data)


def refuse_connection(transport: asyncio.Transport, request: bytes) -> None:
    """Answer a request with the error that the control plane does not answer."""
    _, path, _ = request.split(b" ", 2)
    error = NotReadyError(
        "The control plane of the service does not answer. Try again later.", headers={"Retry-After": "1"}
    )
    answer = answer_of({"path": path.decode("latin-1")}, error)
    headers = b"".join(b"%s: %s\r\n" % each for each in answer.raw_headers)
    transport.write(b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\n%s\r\n" % headers + bytes(answer.body))
    transport.close()


async def adopt(fd: int, protocol: Callable[[], asyncio.Protocol]) -> None:
    """Serve a connection that the other plane has passed on."""
    connection = socket.socket(fileno=fd)
    connection.setblocking(False)
    try:
        await asyncio.get_running_loop().connect_accepted_socket(protocol, connection)
    except OSError:  # the client is gone
        connection.close()
