"""A place for one training process, which is started when it is needed, and can be ended without harm to the others.

Nothing here imports numerics: the process takes its place on the machine before it does, see `training.process`.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing.process import BaseProcess
from typing import Any

from service.compute.process import Place, call, start_process

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
            1,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=start_process,
            initargs=(self.place,),
        )


def _processes(pool: ProcessPoolExecutor) -> list[BaseProcess]:
    # there is no public way to them: `kill_workers` of Python 3.14 may wait
    return list((pool._processes or {}).values())
