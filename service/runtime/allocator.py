"""Memory that the C library of a long-lived process keeps after it is freed.

glibc gives each allocating thread a heap of its own, up to eight per CPU. With every freed block it raises the size
from which it requests a block directly from the system. A service has dozens of threads: memory that one thread freed
is unusable for the others. Memory below a used block never returns to the system. The process grows over thousands of
requests and versions without a leak (`python -m benchmarks soak` plots it).
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Mapping
from enum import IntEnum

HEAPS = 1
"""Number of heaps. With one heap, all threads reuse freed memory. A second heap needs more memory and makes no query
faster, because Python runs one thread at a time."""
BLOCK_BYTES = 1024 * 1024
"""Bytes from which a block is requested from the system and returned to it at once; also the max kept free memory."""


class Mallopt(IntEnum):
    """Parameters of `mallopt`, see malloc.h of glibc."""

    TRIM_THRESHOLD = -1
    MMAP_THRESHOLD = -3
    ARENA_MAX = -8


def limit_free_memory(environment: Mapping[str, str] = os.environ) -> bool:
    """Limit the heaps and the free memory of this process for its lifetime; return whether it does.

    Call it before any thread starts. See `limit_heaps`.
    """
    if not limit_heaps(environment):
        return False
    threading.Thread(target=_release_memory_often, name="release-memory", daemon=True).start()
    return True


def limit_heaps(environment: Mapping[str, str] = os.environ) -> bool:
    """Limit the heaps of this process and of those that it forks; return whether it does.

    It does nothing if the environment has settings of its own, or the C library is not glibc.
    """
    if any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in environment):
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):
        return False
    settings = (
        (Mallopt.ARENA_MAX, HEAPS),
        (Mallopt.MMAP_THRESHOLD, BLOCK_BYTES),
        (Mallopt.TRIM_THRESHOLD, BLOCK_BYTES),
    )
    taken = [library.mallopt(parameter, value) for parameter, value in settings]
    return all(taken)


def release_memory() -> None:
    """Return all free memory of this process to the system; do nothing without glibc."""
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)


def _release_memory_often() -> None:
    while True:
        time.sleep(60.0)  # `malloc_trim` locks a heap for a millisecond
        release_memory()
