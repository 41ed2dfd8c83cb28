"""What goes to and from the processes that read strangers' files: calls, answers, and where each ends."""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from typing import Any, get_origin

import msgspec
import numpy as np

from service.foundation.errors import InvalidDataError, InvalidRequestError, StorageFullError, TooLargeError
from service.foundation.settings import Settings

ANSWER_BYTES = 32 * 1024 * 1024
"""Largest answer: names and facts, as numbers come in files."""
OUTPUT_BYTES = 4096
"""Most that is kept of what a confined process, or a library in it, writes to stdout and stderr."""
ERRORS = {each.code: each for each in (InvalidDataError, InvalidRequestError, StorageFullError, TooLargeError)}
"""What a function may raise, by code; and MissingExtraError, OSError."""
_LENGTH = struct.Struct("<Q")


class Call(msgspec.Struct):
    """A call. function: `module:function`; arguments: an array of its own; read, write: files and folders that it is
    given."""

    function: str
    arguments: msgspec.Raw
    read: list[str]
    write: list[str]
    memory: int
    cpu_s: int
    wall_s: float
    file: int


class Failure(msgspec.Struct):
    """What a function raised. code: of `ERRORS`, or `limit`, `extra`, `system`, `unexpected`; detail: (field, value,
    expected) each, or the limit's name; number: of an error of the system."""

    code: str
    message: str
    detail: list[tuple[str, str | None, str]] = []
    number: int = 0


class Answer(msgspec.Struct):
    """What a confined process sends: the value that its function returned, or why there is none."""

    value: msgspec.Raw = msgspec.Raw(b"\xc0")
    failure: Failure | None = None


class Outcome(msgspec.Struct):
    """What became of a confined process. status: exit code, negative where a signal ended it; late: whether it was
    ended for its time; output: what it wrote; answer: an `Answer`, empty where there is none that is complete."""

    status: int
    late: bool
    output: bytes
    answer: bytes


def plain(value: Any) -> Any:
    """A path, settings or an array as what goes to another process; for msgspec."""
    if isinstance(value, Path):
        return os.fspath(value)
    if isinstance(value, Settings):
        # readers need these settings; no secret begins so
        return {name: getattr(value, name) for name in Settings.model_fields if name.startswith(("max_", "min_"))}
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


def typed(kind: Any, value: Any) -> Any:
    """The way back from `plain`."""
    if kind is Path:
        return Path(value)
    if kind is Settings:
        return Settings.model_construct(**value)  # they have been checked, and the environment is none of theirs
    if get_origin(kind) is np.ndarray:
        return np.array(value, dtype=np.float64)
    raise NotImplementedError(f"a {kind}")


def with_length(data: bytes) -> bytes:
    """Data as they are sent."""
    return _LENGTH.pack(len(data)) + data


def send(connection: socket.socket, data: bytes) -> None:
    """Send data with their length."""
    connection.sendall(with_length(data))


def receive(connection: socket.socket) -> bytes:
    """What the other end sent; raise EOFError where it is closed before."""
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size))
    return _exactly(connection, length)


def _exactly(connection: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        piece = connection.recv(min(count - len(data), 1 << 20))
        if not piece:
            raise EOFError
        data += piece
    return bytes(data)


def complete(data: bytes | bytearray) -> bytes | None:
    """What was sent with its length, once all of it has come."""
    size = _LENGTH.size
    if len(data) < size or _LENGTH.unpack_from(data)[0] != len(data) - size:
        return None
    return bytes(data[size:])
