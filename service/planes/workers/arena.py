"""Memory through which a process gives bytes to another one: written in one copy, and read in place.

It is kept from one message to the next. New pages would cost more than the copy.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence

from service.runtime.pages import Buffer, write_buffers


class Arena:
    """A file in memory. One process writes it, another reads it; a message between them says what is there.

    handle: file descriptor of an arena that another process has made; a new one if None.
    """

    def __init__(self, handle: int | None = None) -> None:
        self.handle = os.memfd_create("lipserve-arena", os.MFD_CLOEXEC) if handle is None else handle
        self._mapped: mmap.mmap | None = None

    def write(self, buffers: Sequence[Buffer]) -> list[tuple[int, int]]:
        """Replace the content and return the start and size of each buffer, without the interpreter's lock."""
        return write_buffers(self.handle, buffers)

    def read(self, spans: Sequence[tuple[int, int]]) -> list[bytes]:
        """Return copies of the buffers, without the interpreter's lock."""
        return [os.pread(self.handle, size, start) for start, size in spans]

    def view(self, spans: Sequence[tuple[int, int]]) -> list[memoryview]:
        """Return the buffers in place: they are valid until the next message."""
        end = max((start + size for start, size in spans), default=0)
        if end and (self._mapped is None or len(self._mapped) < end):
            size = os.fstat(self.handle).st_size
            self._mapped = mmap.mmap(self.handle, size, mmap.MAP_SHARED, mmap.PROT_READ)
        content = memoryview(self._mapped or b"")
        return [content[start : start + size] for start, size in spans]

    def close(self) -> None:
        """Close the file. Its memory is free once both processes have closed it."""
        os.close(self.handle)
