"""How the C library of a long-lived process keeps the memory that it is given back.

glibc gives each thread that allocates a heap of its own, up to eight for each CPU, and raises the size from which on it
asks the system for a block by itself with every block that is freed. A service has dozens of threads: what one of them
frees, no other one uses, and what lies below a block still in use goes back to nobody until it is asked for. Memory
grows over thousands of requests and versions, though nothing is held (`python -m benchmarks soak` plots it).
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Mapping
from enum import IntEnum

HEAPS = 1
"""What one thread frees serves all others. With two, more is left free in between, and no query is answered sooner:
Python's threads take turns anyway."""
BLOCK = 1024 * 1024
"""Bytes from which on a block is the system's own, and goes back to it at once; and of free memory that is kept."""


class Mallopt(IntEnum):
    """Parameters of `mallopt`, see malloc.h of glibc."""

    TRIM_THRESHOLD = -1
    MMAP_THRESHOLD = -3
    ARENA_MAX = -8


def keep_little(environment: Mapping[str, str] = os.environ) -> bool:
    """Have this process keep few heaps and little free memory, as long as it lives; return whether it does.

    To be called before it starts threads. Nothing is done where the environment has settings of its own, or the C
    library is another one.
    """
    if any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in environment):
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):
        return False
    settings = ((Mallopt.ARENA_MAX, HEAPS), (Mallopt.MMAP_THRESHOLD, BLOCK), (Mallopt.TRIM_THRESHOLD, BLOCK))
    taken = [library.mallopt(parameter, value) for parameter, value in settings]
    threading.Thread(target=_give_back_often, name="give-back", daemon=True).start()
    return all(taken)


def give_back() -> None:
    """Give the system all memory that this process has free, wherever it lies; nothing with a library but glibc."""
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)


def _give_back_often() -> None:
    while True:
        time.sleep(60.0)  # it takes a heap's lock for a millisecond
        give_back()
