"""Large batches on several processors: compiled code without the GIL, in the threads of one pool."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

PART = 2048
"""Rows of a part. Smaller batches are not worth a thread: they take milliseconds."""


_most = list[int]()


def limit_threads(count: int) -> None:
    """Use at most `count` threads in this process. A service answers control loops with the other processors."""
    _most[:] = [count]
    _pool.cache_clear()


def run_parts(count: int, run: Callable[[slice], None]) -> None:
    """Call `run` with slices that cover `count` rows: in parallel if there are several parts and processors."""
    parts = [slice(first, min(first + PART, count)) for first in range(0, count, PART)]
    if len(parts) < 2 or _processors() < 2:
        for part in parts:
            run(part)
        return
    for _ in _pool().map(run, parts):
        pass


def _processors() -> int:
    """Return the number of processors to use."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([found, *_most])


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_processors(), "lipcore-batch")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has no threads
