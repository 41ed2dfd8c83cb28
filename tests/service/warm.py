"""Service processes that start quickly: forked from a process that has imported their modules.

Shared services, and training and learning of all services in this process, start in this way; others start as usual.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from multiprocessing import current_process, forkserver, parent_process, popen_forkserver
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from socket import socket
from threading import Lock
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

PRELOADED = [
    "service.app",
    "service.datasets.caged",
    "service.cli",
    "service.training.worker",
    "service.learning.learner.worker",
    "service.learning.weigher.worker",
    "service.planes.workers.process",
    "service.runtime.preload",
    __name__,
]
STARTERS = ("service.runtime.process", "service.runtime.companion")
"""Modules that start processes of the service."""


class _Popen(popen_forkserver.Popen):
    """A forked process whose exit code several threads may request, as it can be read only once (255 afterwards)."""

    reading = Lock()

    def poll(self, flag: int = os.WNOHANG) -> int | None:
        if self.returncode is None and wait([self.sentinel], 0 if flag == os.WNOHANG else None):
            with self.reading:
                super().poll(flag)
        return self.returncode


class _Process(ForkServerProcess):
    """A process with the environment of its parent, like a spawned one."""

    def __init__(
        self,
        group: None = None,
        target: Callable[..., object] | None = None,
        name: str | None = None,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(group, _enter, name, (dict(os.environ), target, args, kwargs or {}), **options)

    @staticmethod
    def _Popen(process_obj: ForkServerProcess) -> _Popen:
        return _Popen(process_obj)


class _Context(ForkServerContext):
    Process = _Process


@cache
def _context() -> _Context:
    made = _Context()
    made.set_forkserver_preload(PRELOADED)
    return made


def _enter(
    environment: dict[str, str], target: Callable[..., object], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    target(*args, **kwargs)


@contextmanager
def warm_processes() -> Iterator[None]:
    """Let services of this process fork their processes."""
    with (
        patch.multiple(STARTERS[0], multiprocessing=_shim()),
        patch.multiple(STARTERS[1], multiprocessing=_shim()),
        patch("service.runtime.cage._context", _context),
    ):
        yield


def _shim() -> SimpleNamespace:
    return SimpleNamespace(get_context=lambda _: _context(), parent_process=parent_process)


def fork(name: str, place: object, connection: socket, function: Callable[..., object], *given: Any) -> _Process:
    """Start a process, as the nursery of a service does."""
    process = _context().Process(target=function, args=(*given, connection), name=name, daemon=True)
    process.start()
    return process


class Served:
    """`lipserve` with arguments in a process of its own, used like `subprocess.Popen`.

    log: file for its output; constants: of the service, by module and name, to replace.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        environment: dict[str, str],
        log: Path,
        constants: Mapping[str, Any] | None = None,
    ) -> None:
        context = _context()
        forkserver.ensure_running()
        address = forkserver._forkserver._forkserver_address  # type: ignore[attr-defined]
        self._process = context.Process(
            target=_serve, args=(list(arguments), environment, log, address, constants or {})
        )
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; return the exit code."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("lipserve", timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        """Send a signal."""
        os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)


def _serve(
    arguments: list[str], environment: dict[str, str], log: Path, address: str, constants: Mapping[str, Any]
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    with log.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    # this process and its children are forked by the same server, which is no child of this process
    forkserver._forkserver._forkserver_address = address  # type: ignore[attr-defined]
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[attr-defined]
    for module in STARTERS:
        import_module(module).multiprocessing = _shim()  # type: ignore[attr-defined]
    import_module("service.runtime.cage")._context = _context  # type: ignore[attr-defined]
    for place, value in constants.items():
        module, _, name = place.rpartition(".")
        vars(import_module(module))[name] = value
    current_process().name = "MainProcess"  # the name in logs
    sys.argv = ["lipserve", *arguments]
    from service.__main__ import main

    main()
