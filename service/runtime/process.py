"""A training process's place on the machine: it gives way to serving.

Nothing here imports numerics. A process takes its place before it does: BLAS and OpenMP start their threads when they
are imported, as many as the environment then says, and on Linux a thread has the priority that its starter had then.
What is set later reaches none of those that run already.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from service.foundation.settings import Settings
from service.runtime.remote import imported
from service.telemetry import logs
from service.telemetry.logs import LogOptions

logger = logging.getLogger(__name__)

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",  # torch
    "OPENBLAS_NUM_THREADS",  # NumPy and SciPy
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
SERVING_THREADS = 1
"""Threads of BLAS for one prediction: a prediction is too short to be shared, and others want the cores."""


@dataclass(frozen=True)
class Place:
    """What a process may take of the machine: threads of each numerical library, priority, CPUs (None: all); log: how
    it says what happens, None: as Python does of itself.

    policy: of scheduling, Linux only; "idle" runs where nothing else wants to, "other" is the usual one. On two CPUs
    neither it nor more niceness kept training out of serving's way as well as leaving one CPU to serving did.
    """

    threads: int
    niceness: int = 0
    policy: Literal["other", "idle"] = "other"
    cpus: frozenset[int] | None = None
    log: LogOptions | None = None


def training_place(settings: Settings) -> Place:
    """The place of training processes."""
    cpus = None
    if hasattr(os, "sched_getaffinity"):  # Linux
        cpus = training_cpus(os.sched_getaffinity(0), settings.training_cpus)
    return Place(settings.training_threads, settings.training_niceness, settings.training_policy, cpus, logs.current())


def training_cpus(available: set[int], most: int | None) -> frozenset[int]:
    """CPUs for training: `most` of those available, all but one where None; the first ones are left to serving."""
    count = max(1, len(available) - 1 if most is None else min(most, len(available)))
    return frozenset(sorted(available)[-count:])


def start_process(place: Place) -> None:
    """Prepare a process of a pool: its place, Ctrl-C left to its parent, and an end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its processes
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(place.threads)))
    os.nice(place.niceness)
    logs.configure(place.log)
    try:
        if place.policy == "idle" and hasattr(os, "sched_setscheduler"):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        if place.cpus is not None:
            os.sched_setaffinity(0, place.cpus)
    except OSError as error:  # a sandbox forbids it: that costs latency, not training
        logger.warning("process %d keeps its place among the others: %s", os.getpid(), error)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def call(module: str, function: str, *given: Any) -> None:
    """Call a function in a process that may not have imported its module yet."""
    getattr(imported(module), function)(*given)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


REAPING_S = 0.5
"""Longest wait for what the system says of a process that has ended, s."""


class Slot:
    """An executor of one process. To be used by one thread."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self._pool = self._new_pool()
        self._process: BaseProcess | None = None

    def start(self, function: Callable[..., None], *given: Any) -> Future[None]:
        """Call a function of a module in the process, started where there is none.

        The future's error is BrokenProcessPool where the process ends before the function does. Raise OSError where no
        process can be started.
        """
        named = function.__module__, function.__qualname__
        try:
            future = self._pool.submit(call, *named, *given)
        except BrokenProcessPool:  # it has died while it had nothing to do
            self._renew()
            future = self._pool.submit(call, *named, *given)
        except OSError:  # a pool does not try again
            self._renew()
            raise
        self._process = next(iter(_processes(self._pool)), None)
        return future

    def kill(self) -> None:
        """End the process at once, whatever it does; the next function has a fresh one."""
        for process in _processes(self._pool):
            process.kill()
        self._renew()

    def close(self) -> None:
        """End the process at once, and wait for its end."""
        for process in _processes(self._pool):
            process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def ending(self) -> str:
        """How the last process has ended, in words."""
        code = None if self._process is None else self._exit_code(self._process)
        if code is None:
            return "ended"
        if code == -signal.SIGKILL:
            return "was killed (SIGKILL, as by a system without memory)"
        with suppress(ValueError):  # a number that is no signal's
            return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"ended with exit code {code}"

    @staticmethod
    def _exit_code(process: BaseProcess) -> int | None:
        process.join(REAPING_S)
        end = time.monotonic() + REAPING_S
        while (code := process.exitcode) is None and time.monotonic() < end:
            time.sleep(REAPING_S / 100)  # the pool's thread has asked the system for it, and is about to tell
        return code

    def _renew(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool = self._new_pool()

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn"), initializer=start_process, initargs=(self.place,)
        )


def _processes(pool: ProcessPoolExecutor) -> list[BaseProcess]:
    # there is no public way to them: `kill_workers` of Python 3.14 may wait
    return list((pool._processes or {}).values())
