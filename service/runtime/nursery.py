"""The nursery: a process without threads, which forks companions, so that they share its imported modules.

The control plane has threads and cannot fork. It forks the nursery before it starts them. See `Companion`.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any
from weakref import WeakSet

from threadpoolctl import threadpool_limits

from service.runtime import forking
from service.runtime.channel import Channel
from service.runtime.process import ProcessOptions

REPLY_S = 10.0
"""Max wait for a reply of the nursery, s."""


class NurseryError(OSError):
    """The nursery has ended."""


class Forked:
    """A process that the nursery has forked; used like `multiprocessing.Process`."""

    def __init__(self, nursery: Nursery, name: str, pid: int, handle: int) -> None:
        self.name, self.pid = name, pid
        self._nursery, self._handle = nursery, handle

    def __del__(self) -> None:
        os.close(self._handle)

    @property
    def exitcode(self) -> int | None:
        """The exit code, negative for a signal; None while it runs, or if the nursery has ended."""
        return None if self.is_alive() else self._nursery.exit_code(self.pid)

    def is_alive(self) -> bool:
        """Return whether it runs."""
        return not wait([self._handle], 0)

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end."""
        wait([self._handle], timeout)

    def kill(self) -> None:
        """Kill it."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._handle, signal.SIGKILL)


class Nursery:
    """The nursery, as the process that has started it sees it. Safe from several threads."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.settimeout(REPLY_S)
        self._channel = Channel(ours)
        self._lock, self._codes, self._forked = threading.Lock(), dict[int, int](), WeakSet[Forked]()

        def work() -> None:
            ours.close()
            _tend(Channel(theirs))

        self.pid = forking.fork(work, "nursery")
        theirs.close()

    def start(
        self, name: str, place: ProcessOptions, connection: Connection, function: Callable[..., object], *given: Any
    ) -> Forked:
        """Fork a process that calls a function of a module with a connection and arguments. Raise OSError."""
        with self._lock:
            self._channel.send((name, place.threads, function, given), [connection.fileno()])
            while True:
                pid, handles = self._receive()
                if handles:
                    self._codes.pop(pid, None)  # of an earlier process with the same id
                    forked = Forked(self, name, pid, handles[0])
                    self._forked.add(forked)
                    return forked

    def running(self) -> list[Forked]:
        """Return the processes that run."""
        with self._lock:
            return [each for each in self._forked if each.is_alive()]

    def exit_code(self, pid: int) -> int | None:
        """Return the exit code of an ended process."""
        with self._lock, suppress(OSError):
            while pid not in self._codes:
                self._receive()
        return self._codes.get(pid)

    def _receive(self) -> tuple[int, list[int]]:
        """Receive the id and the handle of a process that was forked; of one that has ended, keep the exit code."""
        if (received := self._channel.receive()) is None:
            self._channel.close()  # otherwise, a late reply would be read as the reply to another request
            raise NurseryError("the nursery process has ended or does not answer")
        (pid, result), handles = received
        if isinstance(result, OSError):
            raise result
        if not handles:
            self._codes[pid] = result
        return pid, handles


_nursery: Nursery | None = None


def start() -> Nursery:
    """Fork the nursery of this process; call it before any thread starts."""
    global _nursery  # noqa: PLW0603 - one a process
    _nursery = Nursery()
    return _nursery


def current() -> Nursery | None:
    """Return the nursery of this process, None if there is none."""
    return _nursery


def _tend(channel: Channel) -> None:
    """Fork processes on request and report their exit codes, until the parent is gone."""
    handles = dict[int, int]()
    """Ids of the processes, by handle."""
    while True:
        for ready in wait([channel.fileno(), *handles]):
            if ready in handles:
                pid = handles.pop(ready)
                os.close(ready)
                _, status = os.waitpid(pid, 0)
                channel.send((pid, os.waitstatus_to_exitcode(status)))
            elif not _answer(channel, handles):
                return


def _answer(channel: Channel, handles: dict[int, int]) -> bool:
    """Fork the process that the next message requests; return False if the parent is gone."""
    if (received := channel.receive()) is None:
        return False
    (name, threads, function, arguments), given = received
    connection = Connection(given[0])

    def work() -> None:
        channel.close_copy()
        for each in handles:
            os.close(each)
        threadpool_limits(threads)  # numerical libraries are imported, so environment variables come too late
        function(*arguments, connection)

    try:
        pid = forking.fork(work, name)
    except OSError as error:
        channel.send((0, error))
    else:
        _report(channel, handles, pid)
    connection.close()
    return True


def _report(channel: Channel, handles: dict[int, int], pid: int) -> None:
    """Send a handle of a process that was forked; kill the process if the kernel has no handles."""
    try:
        handle = os.pidfd_open(pid)
    except OSError as error:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        channel.send((0, error))
    else:
        handles[handle] = pid
        channel.send((pid, None), [handle])
