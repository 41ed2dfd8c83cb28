"""The threads, priority and CPUs of training processes, which yield to serving.

Nothing here imports numerics. A process sets these options before it imports them: BLAS and OpenMP start their threads
on import, as many as the environment then allows. On Linux a thread inherits the priority of its starter. Later changes
do not reach running threads.
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
from service.runtime.remote import import_without_gc
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
"""Threads of one prediction: a prediction is too short to share, and other work needs the cores."""


@dataclass(frozen=True)
class ProcessOptions:
    """The share of the machine that a process uses, and its log."""

    threads: int
    """Threads of each numerical library."""
    niceness: int = 0
    policy: Literal["other", "idle"] = "other"
    """Scheduling policy, Linux only: "idle" runs if nothing else needs the CPU, "other" is the usual one.

    On two CPUs, a CPU reserved for serving protected its latency from training better than "idle" or more niceness.
    """
    cpus: frozenset[int] | None = None
    """CPUs it may use, None for all."""
    log: LogOptions | None = None
    """Its log options, None for Python's default."""


def training_process_options(settings: Settings) -> ProcessOptions:
    """Return the options of training processes."""
    cpus = None
    if hasattr(os, "sched_getaffinity"):  # Linux
        cpus = training_cpus(os.sched_getaffinity(0), settings.training_cpus)
    return ProcessOptions(
        settings.training_threads, settings.training_niceness, settings.training_policy, cpus, logs.current_options()
    )


def training_cpus(available: set[int], most: int | None) -> frozenset[int]:
    """Return the last `most` of the available CPUs for training; all but the first if None."""
    count = max(1, len(available) - 1 if most is None else min(most, len(available)))
    return frozenset(sorted(available)[-count:])


def start_process(place: ProcessOptions) -> None:
    """Prepare a process of a pool: set its options, ignore Ctrl-C, and end it with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its processes
    limit_library_threads(place.threads)
    os.nice(place.niceness)
    logs.configure(place.log)
    try:
        if place.policy == "idle" and hasattr(os, "sched_setscheduler"):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        if place.cpus is not None:
            os.sched_setaffinity(0, place.cpus)
    except OSError as error:  # a sandbox forbids it: that costs latency, not training
        logger.warning("could not set the scheduling of process %d: %s", os.getpid(), error)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def limit_library_threads(count: int) -> None:
    """Set the number of threads of the numerical libraries that this process imports later."""
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))


def call(module: str, function: str, *given: Any) -> None:
    """Call a function in a process that may not have imported its module yet."""
    getattr(import_without_gc(module), function)(*given)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


MAX_EXIT_WAIT_S = 0.5
"""Max wait for the exit code of an ended process, s."""


class Slot:
    """An executor of one process. Use it from one thread."""

    def __init__(self, place: ProcessOptions) -> None:
        self.place = place
        self._pool = self._new_pool()
        self._process: BaseProcess | None = None

    def start(self, function: Callable[..., None], *given: Any) -> Future[None]:
        """Call a function of a module in the process; start the process if there is none.

        The future's error is BrokenProcessPool if the process ends before the function. Raise OSError if no process can
        start.
        """
        named = function.__module__, function.__qualname__
        try:
            future = self._pool.submit(call, *named, *given)
        except BrokenProcessPool:  # it died while it was idle
            self._renew()
            future = self._pool.submit(call, *named, *given)
        except OSError:  # a pool does not retry
            self._renew()
            raise
        self._process = next(iter(_processes(self._pool)), None)
        return future

    def kill(self) -> None:
        """Kill the process at once; the next function gets a new one."""
        for process in _processes(self._pool):
            process.kill()
        self._renew()

    def close(self) -> None:
        """Kill the process at once, and wait for its end."""
        for process in _processes(self._pool):
            process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def ending(self) -> str:
        """Return in words how the last process ended."""
        code = None if self._process is None else self._exit_code(self._process)
        if code is None:
            return "ended"
        if code == -signal.SIGKILL:
            return "was killed (SIGKILL: the system may be out of memory)"
        with suppress(ValueError):  # not the number of a signal
            return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return f"ended with exit code {code}"

    @staticmethod
    def _exit_code(process: BaseProcess) -> int | None:
        process.join(MAX_EXIT_WAIT_S)
        end = time.monotonic() + MAX_EXIT_WAIT_S
        while (code := process.exitcode) is None and time.monotonic() < end:
            time.sleep(MAX_EXIT_WAIT_S / 100)  # the pool's thread has read it and is about to store it
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
