"""Messages to and from the processes that read uploads: calls and answers, each with its length."""

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

MAX_ANSWER_BYTES = 32 * 1024 * 1024
"""Max size of an answer: names and facts, as numbers are sent in files."""
MAX_OUTPUT_BYTES = 4096
"""Max kept output of a confined process and its libraries to stdout and stderr."""
ERRORS = {each.code: each for each in (InvalidDataError, InvalidRequestError, StorageFullError, TooLargeError)}
"""Errors that a function may raise, by code; MissingExtraError and OSError are allowed too."""
_LENGTH = struct.Struct("<Q")


class Call(msgspec.Struct):
    """A call of a function."""

    function: str
    """`module:function`."""
    arguments: msgspec.Raw
    """Encoded array of the arguments."""
    read: list[str]
    """Files and folders that the function may read."""
    write: list[str]
    """Files and folders that the function may write."""
    memory: int
    """Max bytes of memory beyond those of the process."""
    cpu_s: int
    """Max processor time, s."""
    wall_s: float
    """Max time, s."""
    file: int
    """Max bytes of each file that the function writes."""


class Failure(msgspec.Struct):
    """The error that a function raised."""

    code: str
    """A code of `ERRORS`, or `limit`, `extra`, `system`, `unexpected`."""
    message: str
    """Text of the error, or the name of the limit."""
    detail: list[tuple[str, str | None, str]] = []
    """(field, value, expected) of each problem."""
    number: int = 0
    """Number of a system error."""


class Answer(msgspec.Struct):
    """The answer of a confined process: the value of its function, or the error."""

    value: msgspec.Raw = msgspec.Raw(b"\xc0")
    failure: Failure | None = None


class Outcome(msgspec.Struct):
    """The end of a confined process."""

    status: int
    """Exit code; negative if a signal ended the process."""
    late: bool
    """Whether it was ended because its time was over."""
    output: bytes
    """Its output to stdout and stderr."""
    answer: bytes
    """An `Answer`; empty if there is no complete one."""


def to_plain(value: Any) -> Any:
    """Return a path, settings or an array as a plain value for another process; a hook of msgspec."""
    if isinstance(value, Path):
        return os.fspath(value)
    if isinstance(value, Settings):
        # readers need these settings; no secret has such a name
        return {name: getattr(value, name) for name in Settings.model_fields if name.startswith(("max_", "min_"))}
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"a {type(value).__name__}")


def from_plain(kind: Any, value: Any) -> Any:
    """Return the value that `to_plain` encoded."""
    if kind is Path:
        return Path(value)
    if kind is Settings:
        return Settings.model_construct(**value)  # already checked; the reader's environment has no settings
    if get_origin(kind) is np.ndarray:
        return np.array(value, dtype=np.float64)
    raise NotImplementedError(f"a {kind}")


def prepend_length(data: bytes) -> bytes:
    """Return data with their length in front."""
    return _LENGTH.pack(len(data)) + data


def send(connection: socket.socket, data: bytes) -> None:
    """Send data with their length."""
    connection.sendall(prepend_length(data))


def receive(connection: socket.socket) -> bytes:
    """Return the data of one message; raise EOFError if the connection is closed before its end."""
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


def unpack_complete(data: bytes | bytearray) -> bytes | None:
    """Return the data of a message, None until all of it has arrived."""
    size = _LENGTH.size
    if len(data) < size or _LENGTH.unpack_from(data)[0] != len(data) - size:
        return None
    return bytes(data[size:])
