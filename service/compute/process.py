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
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from service.foundation.importing import imported
from service.foundation.settings import Settings
from service.web.observability import logs
from service.web.observability.logs import LogOptions

logger = logging.getLogger(__name__)

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",  # torch
    "OPENBLAS_NUM_THREADS",  # NumPy and SciPy
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)


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
