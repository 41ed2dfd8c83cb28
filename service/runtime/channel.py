"""Messages between the processes of a service, over a Unix socket that keeps their bounds (SOCK_SEQPACKET).

A message is a pickled object; both ends are processes of one service. Large messages and their arrays travel in a file
in memory, which every receiver maps: it copies nothing, and the pages are shared. Arrays that `share` has put into such
a file are not even written again.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from service.runtime.pages import Buffer, Pages, find_pages, map_file, write_buffers

logger = logging.getLogger(__name__)

MAX_MESSAGE_BYTES = 160 * 1024
"""Max bytes of a message without its file: below the default send buffer of Linux, 208 KiB."""
MIN_SHARED_BYTES = 32 * 1024
"""Bytes from which on a message and its arrays travel in a file in memory."""
MAX_KEPT_FILES = 2
"""Max files of a message that `share` has made: those of a version and its revision. Further arrays are copied."""
MAX_FDS = MAX_KEPT_FILES + 2
"""Max file descriptors of a message, with those of its files."""
_FD = struct.Struct("i")
_HEAD = struct.Struct("<IB")
"""Size of the pickled places, and number of files. A header without a size is that of no message."""
T = TypeVar("T")


class Place(NamedTuple):
    """Where an array is: which file of the message, and where in it."""

    file: int
    start: int
    size: int


@dataclass
class Package:
    """A message ready to be sent, to several receivers if necessary. Close it afterwards."""

    data: bytes
    """The message, unless it is in the first file."""
    file: int | None = None
    """Descriptor of a file in memory, with the message and arrays; None for a small message."""
    places: list[Place] = field(default_factory=list)
    """Place of the message itself, if it is in the file, and of each array."""
    kept: list[Pages] = field(default_factory=list)
    """The further files, which `share` has made."""

    @classmethod
    def of(cls, message: Any) -> Package:
        """Pickle a message."""
        buffers = list[pickle.PickleBuffer]()
        data = pickle.dumps(message, 5, buffer_callback=buffers.append)
        views = [each.raw() for each in buffers]
        if len(data) + sum(each.nbytes for each in views) < MIN_SHARED_BYTES:
            return cls(pickle.dumps(message, 5) if views else data)
        kept, written, places = list[Pages](), list[Buffer]([data]), list[Place | None]([None])
        for view in views:
            pages, start = find_pages(view) or (None, 0)
            if pages is not None and pages not in kept and len(kept) < MAX_KEPT_FILES:
                kept.append(pages)
            if pages in kept:
                places.append(Place(1 + kept.index(pages), start, view.nbytes))
            else:
                written.append(view)
                places.append(None)
        file = os.memfd_create("lipserve", os.MFD_CLOEXEC)
        try:
            spans = write_buffers(file, written)
            os.ftruncate(file, sum(spans[-1]))  # an empty last array begins beyond the end
        except BaseException:
            os.close(file)
            raise
        own = (Place(0, *span) for span in spans)
        return cls(b"", file, [place or next(own) for place in places], kept)

    @property
    def files(self) -> list[int]:
        """Descriptors of all files."""
        return [] if self.file is None else [self.file, *(each.file for each in self.kept if each.file is not None)]

    @property
    def size(self) -> int:
        """Bytes of the message with the arrays that it does not take from further files."""
        return len(self.data) or max(sum(each[1:]) for each in self.places if each.file == 0)

    def close(self) -> None:
        """Close the file; receivers keep their mappings."""
        if self.file is not None:
            os.close(self.file)
            self.file = None


def share(value: T) -> T:
    """Return an equal object whose large arrays lie in a file in memory, which messages pass on without a copy.

    A small object is returned as it is.
    """
    package = Package.of(value)
    try:
        return value if package.file is None else _unpickle(package.places, package.files, keep=True)
    finally:
        package.close()


class Channel:
    """One end of a connection. One thread may receive while others send."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    def fileno(self) -> int:
        """Return the file descriptor of the connection."""
        return self._socket.fileno()

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
        places, files = pickle.dumps([tuple(each) for each in package.places], 5), package.files
        given = [*fds, *files]
        parts = [_HEAD.pack(len(places), len(files)), places, package.data]
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

    def close_copy(self) -> None:
        """Close the end that this process has inherited; it stays open in the process that has forked this one."""
        self._socket.close()

    def close(self) -> None:
        """Close it; a thread that receives gets None."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _read(data: bytes, fds: list[int]) -> Any:
    """Return the message in these bytes, and remove the descriptors of its files."""
    size, count = _HEAD.unpack_from(data)
    places = pickle.loads(data[_HEAD.size : _HEAD.size + size])  # noqa: S301 - from a process of this service
    if not count:
        return pickle.loads(data[_HEAD.size + size :])  # noqa: S301 - as above
    if count > len(fds):
        raise ValueError("a file is missing")
    files = fds[-count:]
    del fds[-count:]
    try:
        return _unpickle([Place(*each) for each in places], files)
    finally:
        for file in files:
            os.close(file)


def _unpickle(places: Sequence[Place], files: Sequence[int], keep: bool = False) -> Any:
    """Return the object at these places. keep: see `map_file`; of the first file."""
    ends = (max(each.start + each.size for each in places if each.file == number) for number in range(len(files)))
    contents = [map_file(file, end, keep and file == files[0]) for file, end in zip(files, ends, strict=True)]
    message, *buffers = (contents[file][start : start + size] for file, start, size in places)
    return pickle.loads(message, buffers=buffers)  # noqa: S301 - from a process of this service
