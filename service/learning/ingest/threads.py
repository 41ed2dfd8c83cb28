"""Threads that take observations: few, and behind those that answer queries."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

from service.compute.process import Place
from service.foundation.errors import BusyError

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
MOST_THREADS = 2
"""Batches taken at the same time; those of one model take turns."""
MOST_WAITING = 100
"""Batches that wait for their turn; more are refused, as their rows fill the memory."""


class IngestThreads:
    """Threads of their own, which on Linux give way to all others: a batch of 100 rows takes 10 to 40 ms.

    With the priority of the thread that answers, they doubled the slowest hundredth of answers beside a 1 kHz stream.
    """

    def __init__(self, place: Place) -> None:
        self._threads = ThreadPoolExecutor(MOST_THREADS, "ingest", initializer=_take_place, initargs=(place,))
        self._waiting = 0

    async def run(self, work: Callable[..., Result], *args: Any) -> Result:
        """Do work in the next free thread; raise BusyError where too much waits already. For the event loop."""
        waiting = self._waiting - MOST_THREADS
        if waiting >= MOST_WAITING:
            raise BusyError(f"{waiting} batches are waiting to be logged, the most that may: try again later")
        self._waiting += 1
        try:
            # what has begun is done to its end, whether anyone still waits for it or not
            run = copy_context().run  # what is logged names the request
            return await asyncio.shield(asyncio.get_running_loop().run_in_executor(self._threads, run, work, *args))
        finally:
            self._waiting -= 1

    def close(self) -> None:
        """Finish what has begun, and take no more."""
        self._threads.shutdown(cancel_futures=True)


def _take_place(place: Place) -> None:
    if sys.platform != "linux":  # elsewhere it is the process that would give way
        return
    try:
        os.setpriority(os.PRIO_PROCESS, 0, os.getpriority(os.PRIO_PROCESS, 0) + place.niceness)
        if place.cpus is not None:
            os.sched_setaffinity(0, place.cpus)
    except OSError as error:  # a sandbox forbids it: that costs latency, not learning
        logger.warning("the threads that take observations keep their place among the others: %s", error)
