"""Minimal WebSocket client of torque streams: prepared frames, one read an answer.

The package's own `StreamClient` builds frames, decodes answers and reads in a thread; it is timed separately.
"""

from __future__ import annotations

import base64
import os

import numpy as np

from benchmarks.clients import Address, BadAnswerError, Connection, GoneError, connect
from lipcore.data.samples import Array
from lipserve.frames import ANSWER, ASK_STD, ERROR, HAS_STD, NUMBER, REQUEST

_BINARY, _TEXT, _CLOSE, _PING, _PONG = 2, 1, 8, 9, 10
_FINAL, _MASKED = 0x80, 0x80
_NO_MASK = bytes(4)
"""Clients must mask their frames; a mask of zeros changes nothing, and costs the service as much as any other."""


def request_frame(motion: Array, std: bool = True, deadline: float = 0.0, sequence: int = 0) -> bytes:
    """Return the frame of one motion, (3, n); deadline in s, 0: none."""
    header = REQUEST.pack(sequence, ASK_STD if std else 0, motion.shape[1], deadline)
    return frame(header + np.ascontiguousarray(motion, NUMBER).tobytes())


def read_answer(data: bytes) -> tuple[Array, Array | None, int]:
    """Return torque, its standard deviation if present, and the connection's count of late answers."""
    _, flags, n, _, late, _, _ = ANSWER.unpack_from(data)
    if flags & ERROR:
        raise BadAnswerError(data[ANSWER.size :].decode(errors="replace"))
    numbers = np.frombuffer(data, NUMBER, offset=ANSWER.size)
    return numbers[:n], numbers[n:] if flags & HAS_STD else None, late


def frame(payload: bytes, opcode: int = _BINARY) -> bytes:
    """Return one message as a client's frame."""
    size = len(payload)
    if size < 126:
        head = bytes((_FINAL | opcode, _MASKED | size))
    elif size < 1 << 16:
        head = bytes((_FINAL | opcode, _MASKED | 126)) + size.to_bytes(2, "big")
    else:
        raise ValueError(f"The message has {size} bytes; at most {(1 << 16) - 1} are allowed.")
    return head + _NO_MASK + payload


class WebSocket(Connection):
    """A client that sends one message at a time and waits for the binary answer.

    Pings are answered only during a call. The service closes an idle connection; the next call reconnects.
    """

    def __init__(self, address: Address, path: str) -> None:
        self._address, self._path = address, path
        self._open()

    def _open(self) -> None:
        self._socket, self._left, path = connect(self._address), b"", self._path
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            f"GET {path} HTTP/1.1",
            "host: localhost",
            "upgrade: websocket",
            "connection: Upgrade",
            "sec-websocket-version: 13",
            f"sec-websocket-key: {key}",
        )
        self._socket.sendall("\r\n".join(lines).encode() + b"\r\n\r\n")
        while (end := self._left.find(b"\r\n\r\n")) < 0:
            self._left += self._more()
        head, self._left = self._left[:end], self._left[end + 4 :]
        if not head.startswith(b"HTTP/1.1 101"):
            raise BadAnswerError(f"{path}: {head.decode(errors='replace').splitlines()[0]}: {self._left.decode()}")

    def ask(self, message: bytes) -> bytes:
        """Send a message built by `frame` and return the payload of the next binary one."""
        try:
            return self._ask(message)
        except (GoneError, ConnectionError):
            self._socket.close()
            self._open()
            return self._ask(message)

    def _ask(self, message: bytes) -> bytes:
        self._socket.sendall(message)
        while True:
            opcode, payload = self._next()
            if opcode == _BINARY:
                return payload
            if opcode == _PING:
                self._socket.sendall(frame(payload, _PONG))
            elif opcode == _CLOSE:
                raise GoneError(f"The service closed the stream: {payload[2:].decode(errors='replace')}")
            elif opcode != _TEXT:  # texts describe a version; nothing here needs them
                raise BadAnswerError(f"The service sent a frame with opcode {opcode}.")

    def _next(self) -> tuple[int, bytes]:
        data = self._left or self._more()
        while len(data) < 2:
            data += self._more()
        size, start = data[1] & 0x7F, 2
        if size == 126:
            while len(data) < 4:
                data += self._more()
            size, start = int.from_bytes(data[2:4], "big"), 4
        elif size == 127:
            raise BadAnswerError("The service sent a frame of 64 KiB or more.")
        end = start + size
        while len(data) < end:
            data += self._more()
        self._left = data[end:]
        return data[0] & 0x0F, data[start:end]
