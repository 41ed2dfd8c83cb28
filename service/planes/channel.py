"""Messages between the planes, over a Unix socket that keeps their bounds (SOCK_SEQPACKET).

A message is a pickled object; both ends are processes of one service. Large messages and their arrays travel in a file
in memory, which every receiver maps: it copies nothing, and the pages are shared.
"""

from __future__ import annotations

import logging
import os
import pickle
import socket
import struct
from array import array
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.planes.pages import map_file, write_buffers

logger = logging.getLogger(__name__)

MAX_MESSAGE_BYTES = 160 * 1024
"""Max bytes of a message without its file: below the default send buffer of Linux, 208 KiB."""
MIN_SHARED_BYTES = 32 * 1024
"""Bytes from which on a message and its arrays travel in a file in memory."""
MAX_FDS = 4
"""Max file descriptors of a message, with that of its file."""
_FD = struct.Struct("i")
_HEAD = struct.Struct("<I?")
"""Size of the pickled places, and whether the message has a file. A header without a size is that of no message."""


@dataclass
class Package:
    """A message ready to be sent, to several receivers if necessary. Close it afterwards."""

    places: list[tuple[int, int]]
    """Begin and size of each array in the file, of the message itself first."""
    data: bytes
    """The message, unless it is in the file."""
    file: int | None
    """Descriptor of the file in memory; None for a small message."""

    @classmethod
    def of(cls, message: Any) -> Package:
        """Pickle a message."""
        buffers = list[pickle.PickleBuffer]()
        data = pickle.dumps(message, 5, buffer_callback=buffers.append)
        views = [each.raw() for each in buffers]
        size = len(data) + sum(each.nbytes for each in views)
        if size < MIN_SHARED_BYTES:
            return cls([], pickle.dumps(message, 5) if views else data, None)
        file = os.memfd_create("lipserve", os.MFD_CLOEXEC)
        try:
            places = write_buffers(file, [data, *views])
            os.ftruncate(file, sum(places[-1]))  # an empty last array begins beyond the end
        except BaseException:
            os.close(file)
            raise
        return cls(places, b"", file)

    @property
    def size(self) -> int:
        """Bytes of the message with its arrays."""
        return len(self.data) if self.file is None else sum(self.places[-1])

    def close(self) -> None:
        """Close the file; receivers keep their mappings."""
        if self.file is not None:
            os.close(self.file)
            self.file = None


class Channel:
    """One end of a connection. One thread may receive while others send."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    def limit_wait(self, seconds: float) -> None:
        """Limit the time that `send` waits for room if the other end hangs."""
        limit = struct.pack("ll", int(seconds), int(1e6 * (seconds % 1)))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)

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
        package = message if isinstance(message, Package) else Package.of(message)
        places, given = pickle.dumps(package.places, 5), list(fds)
        if package.file is not None:
            given.append(package.file)
        parts = [_HEAD.pack(len(places), package.file is not None), places, package.data]
        try:
            # not `socket.send_fds`: it ignores flags, and would wait
            rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array("i", given))] if given else []
            self._socket.sendmsg(parts, rights, 0 if wait else socket.MSG_DONTWAIT)
        except OSError:
            return False
        finally:
            if package is not message:
                package.close()
        return True

    def receive(self) -> tuple[Any, list[int]] | None:
        """Wait for a message; return it with its file descriptors. Return None if the other end is gone.

        A message that cannot be read ends the connection: both ends connect again and begin anew.
        """
        try:
            # not `socket.recv_fds`: it ignores flags, and a started process would inherit the descriptors
            data, rest, flags, _ = self._socket.recvmsg(
                MAX_MESSAGE_BYTES, socket.CMSG_LEN(MAX_FDS * _FD.size), socket.MSG_CMSG_CLOEXEC
            )
        except OSError:
            return None
        fds = [fd for *_, part in rest for (fd,) in _FD.iter_unpack(part[: len(part) // _FD.size * _FD.size])]
        try:
            if not data:
                raise EOFError
            if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
                raise ValueError("the message is larger than the limit")
            return _read(data, fds), fds
        except Exception as error:
            for fd in fds:
                os.close(fd)
            if data:
                logger.error("a message of another process of this service cannot be read: %s", error)
            return None

    def close(self) -> None:
        """Close it; a thread that receives gets None."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _read(data: bytes, fds: list[int]) -> Any:
    """Return the message in these bytes, and remove the descriptor of its file."""
    size, has_file = _HEAD.unpack_from(data)
    places = pickle.loads(data[_HEAD.size : _HEAD.size + size])  # noqa: S301 - from a process of this service
    if not has_file:
        return pickle.loads(data[_HEAD.size + size :])  # noqa: S301 - as above
    file = fds.pop()
    try:
        content = map_file(file, sum(places[-1]))
    finally:
        os.close(file)
    message, *buffers = (content[at : at + length] for at, length in places)
    return pickle.loads(message, buffers=buffers)  # noqa: S301 - as above
