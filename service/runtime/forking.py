"""Processes that are forked, and so share the memory of all that their parent has imported. Linux only.

A fork copies only the thread that calls it. A lock that another thread holds stays locked in the child for ever, so a
process that forks has no other threads. A forked process ends with its parent.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import pickle
import signal
import sys
from collections.abc import Callable, Container
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)
FAILED = 1
"""Exit code of a process that an unexpected error ended."""


class Prctl(IntEnum):
    """Options of `prctl`, see its manual page."""

    SET_PDEATHSIG = 1
    SET_CHILD_SUBREAPER = 36


class ThreadsError(RuntimeError):
    """This process cannot fork, as it has threads."""


def check_threads() -> None:
    """Raise ThreadsError if this process has more threads than this one, those of libraries included."""
    names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    if len(names) > 1:
        raise ThreadsError(
            f"The service cannot fork its processes, as a library has started threads ({', '.join(names)}). "
            "Set LIPSERVE_DATA_PLANE=off to run it as one process."
        )


def fork(work: Callable[[], object], name: str) -> int:
    """Fork a process that calls `work` and ends; return its id. Raise OSError.

    name: of the process in the log; `ps -o comm` shows its first 11 letters. The process blocks no signals, and ignores
    Ctrl-C, which reaches the whole process group: its parent ends it.
    """
    parent = os.getpid()
    pid = os.fork()
    if pid:
        return pid
    code = FAILED
    try:
        _end_with(parent)
        signal.pthread_sigmask(signal.SIG_SETMASK, ())
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        rename(name)
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else FAILED
    except BaseException:
        logger.exception("the %s process failed", name)
    finally:
        with suppress(OSError, ValueError):  # a closed output
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)  # not `sys.exit`: what was to be done at exit is the parent's


def rename(name: str) -> None:
    """Give this process another name in logs and in lists of processes."""
    multiprocessing.current_process().name = f"lipserve-{name}"
    with suppress(OSError):
        Path("/proc/self/comm").write_text(f"lip-{name}")


def call(function: Callable[..., object], *given: object) -> None:
    """Call a function in a process of its own, as it may start threads; raise its error.

    Raise ChildProcessError if the process ends otherwise.
    """
    reading, writing = os.pipe()

    def work() -> None:
        try:
            function(*given)
        except Exception as error:
            os.write(writing, pickle.dumps(error))

    pid = fork(work, "check")
    os.close(writing)
    with open(reading, "rb") as pipe:
        content = pipe.read()
    _, status = os.waitpid(pid, 0)
    if content:
        raise pickle.loads(content)  # noqa: S301 - of a process of this program
    if status:
        raise ChildProcessError(f"a process ended with exit code {os.waitstatus_to_exitcode(status)}")


def adopt_orphans() -> None:
    """Become the parent of descendants whose parents end."""
    _prctl(Prctl.SET_CHILD_SUBREAPER, 1)


def kill_orphans(kept: Container[int | None]) -> bool:
    """Kill the children of this process and its group, but some; return whether there were any.

    A container's first process also adopts processes that others have started in the container, in other groups.
    """
    group = os.getpgrp()  # 0: a group from outside the container
    orphans = [pid for pid in children() if pid not in kept and group and _group(pid) == group]
    for pid in orphans:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return bool(orphans)


def children() -> list[int]:
    """Return the ids of the children of this process, which has one thread; none if the kernel does not list them."""
    pid = os.getpid()
    with suppress(FileNotFoundError):
        return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def _group(pid: int) -> int | None:
    try:
        return os.getpgid(pid)
    except ProcessLookupError:
        return None


def _end_with(parent: int) -> None:
    _prctl(Prctl.SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended already
        os._exit(FAILED)


def _prctl(option: Prctl, value: Any) -> None:
    ctypes.CDLL(None).prctl(int(option), int(value), 0, 0, 0)
