"""Files in memory: how they are written and mapped, and how those of an array are found.

Nothing here imports numerics: a companion process sets its options before it does, see `service.runtime.companion`.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from collections.abc import Sequence
from typing import Any
from weakref import WeakValueDictionary

_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
_libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
_FAILED = ctypes.c_void_p(-1).value
Buffer = bytes | memoryview
ALIGNMENT = 64
"""Bytes of which the start of each buffer is a multiple, as of NumPy's own arrays."""


def write_buffers(file: int, buffers: Sequence[Buffer]) -> list[tuple[int, int]]:
    """Write buffers one after another; return the start and size of each. Writing needs no interpreter lock."""
    spans, at = list[tuple[int, int]](), 0
    for each in buffers:
        data, done = memoryview(each), 0
        while done < data.nbytes:
            done += os.pwrite(file, data[done:], at + done)
        spans.append((at, data.nbytes))
        at += -(-data.nbytes // ALIGNMENT) * ALIGNMENT
    return spans


class Pages:
    """Mapped pages of a file. They are freed with the last buffer that refers to them.

    file: descriptor of the file, if it is kept.
    """

    def __init__(self, address: int, size: int, file: int | None = None) -> None:
        self.address, self.size, self.file = address, size, file

    def view(self) -> memoryview:
        """Return their content, which keeps them mapped."""
        content: Any = (ctypes.c_ubyte * self.size).from_address(self.address)
        content.pages = self
        return memoryview(content).cast("B")

    def __del__(self) -> None:
        size, self.size = self.size, 0  # another thread may look for pages meanwhile: `munmap` does not hold the lock
        _libc.munmap(self.address, size)
        if self.file is not None:
            os.close(self.file)


_kept: WeakValueDictionary[int, Pages] = WeakValueDictionary()


def map_file(file: int, size: int, keep: bool = False) -> memoryview:
    """Return the first `size` bytes of a file, at least one. Raise OSError or ValueError.

    keep: whether `find_pages` shall find the file. It then has a descriptor as long as an array refers to it, as with
    `mmap.mmap`: a process may map thousands of files, but has few descriptors. The pages are private and writable, like
    those of other arrays. They stay shared, because nobody writes to them.
    """
    if not 0 < size <= os.fstat(file).st_size:  # reading beyond the end would kill the process
        raise ValueError(f"the file has {os.fstat(file).st_size} bytes, expected {size}")
    address = _libc.mmap(None, size, mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_PRIVATE, file, 0)
    if address == _FAILED:
        raise OSError(ctypes.get_errno(), "a file in memory cannot be mapped")
    pages = Pages(address, size, os.dup(file) if keep else None)
    if keep:
        _kept[address] = pages
    return pages.view()


def find_pages(buffer: memoryview) -> tuple[Pages, int] | None:
    """Return the kept pages that contain a buffer, and where it starts in their file; None if there are none."""
    if not buffer.nbytes:
        return None
    import numpy as np  # noqa: PLC0415 - see above

    address: int = np.frombuffer(buffer, np.uint8).__array_interface__["data"][0]
    for known in _kept.valuerefs():  # a copy, unlike `values`: other threads map files meanwhile
        pages = known()
        if pages is not None and pages.address <= address <= pages.address + pages.size - buffer.nbytes:
            return pages, address - pages.address
    return None
