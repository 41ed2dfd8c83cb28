"""Messages between the planes, over a Unix socket that keeps their bounds (SOCK_SEQPACKET).

A message is a pickled object; both ends are processes of one service. Large arrays travel in a file in memory, which
the receiver maps: it copies nothing and needs no interpreter lock for it.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Any

MAX_MESSAGE_BYTES = 160 * 1024
"""Max bytes of a message without its arrays: below the default send buffer of Linux, 208 KiB."""
MIN_SHARED_BYTES = 32 * 1024
"""Bytes of arrays from which on they travel in a file in memory."""


class Channel:
    """One end of a connection. One thread may receive while others send."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    @classmethod
    def connect(cls, path: Path) -> Channel:
        """Connect to the control plane; raise OSError."""
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.connect(os.fspath(path))
        except OSError:
            connection.close()
            raise
        return cls(connection)

    def send(self, message: Any, fds: Sequence[int] = (), wait: bool = True) -> bool:
        """Send a message and copies of file descriptors; return whether it was sent.

        wait: whether to wait for room. False is for an event loop: the other end may hang.
        """
        buffers: list[pickle.PickleBuffer] = []
        data = pickle.dumps(message, 5, buffer_callback=buffers.append)
        views = [each.raw() for each in buffers]
        size, shared, ends = sum(each.nbytes for each in views), -1, list[int]()
        if 0 < size < MIN_SHARED_BYTES:
            data = pickle.dumps(message, 5)
        elif size:
            ends = [0, *accumulate(-(-each.nbytes // 64) * 64 for each in views)]
            shared = os.memfd_create("lipserve", os.MFD_CLOEXEC)
            for view, at in zip(views, ends, strict=False):
                os.pwrite(shared, view, at)
            os.ftruncate(shared, ends[-1])
        spans = [(at, each.nbytes) for at, each in zip(ends, views, strict=False)]
        given = [*fds, *([shared] if shared >= 0 else [])]
        try:
            header = pickle.dumps((spans, len(fds)), 5)
            parts = [len(header).to_bytes(2, "little"), header, data]
            socket.send_fds(self._socket, parts, given, 0 if wait else socket.MSG_DONTWAIT)
        except OSError:
            return False
        finally:
            if shared >= 0:
                os.close(shared)
        return True

    def receive(self) -> tuple[Any, list[int]] | None:
        """Wait for a message; return it with its file descriptors, None if the other end is gone."""
        try:
            data, fds, _, _ = socket.recv_fds(self._socket, MAX_MESSAGE_BYTES, 4)
        except OSError:
            return None
        if not data:
            return None
        start = 2 + int.from_bytes(data[:2], "little")
        spans, count = pickle.loads(data[2:start])  # noqa: S301 - from a process of this service
        buffers: list[memoryview] = []
        if spans:
            # private and writable, as other arrays are: pages stay shared because nobody writes
            content = memoryview(mmap.mmap(fds[count], 0, mmap.MAP_PRIVATE))
            os.close(fds[count])
            buffers = [content[at : at + size] for at, size in spans]
        return pickle.loads(data[start:], buffers=buffers), fds[:count]  # noqa: S301 - as above

    def close(self) -> None:
        """Close it; a thread that receives gets None."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
