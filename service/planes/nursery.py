"""A process that forks the learner and the weigher, which share what it has imported."""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from service.planes.channel import Channel

_channel: Channel | None = None


class Forked:
    """A forked process, as far as `Companion` needs one."""

    def __init__(self, pid: int, name: str) -> None:
        self.pid, self.name, self.exitcode = pid, name, None
        self._handle = os.pidfd_open(pid)

    def is_alive(self) -> bool:
        """Return whether the process runs."""
        return not select.select([self._handle], [], [], 0)[0]

    def join(self, seconds: float | None = None) -> None:
        """Wait for its end."""
        select.select([self._handle], [], [], seconds)

    def kill(self) -> None:
        """Kill it."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._handle, signal.SIGKILL)


def start() -> None:
    """Fork the nursery; call it before any thread starts."""
    global _channel  # noqa: PLW0603 - one a process
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if os.fork():
        theirs.close()
        _channel = Channel(ours)
        return
    ours.close()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps
    channel = Channel(theirs)
    while (received := channel.receive()) is not None:
        (given, fds) = received
        pid = os.fork()
        if not pid:
            theirs.close()
            _run(given, fds[0])
        os.close(fds[0])
        channel.send(pid)
    os._exit(0)


def fork(name: str, given: tuple[Any, ...], theirs: Connection) -> Forked:
    """Fork a process that runs `companion._begin`."""
    assert _channel is not None
    _channel.send(given, [theirs.fileno()])
    received = _channel.receive()
    assert received is not None
    return Forked(received[0], name)


def is_running() -> bool:
    """Return whether there is a nursery."""
    return _channel is not None


def _run(given: tuple[Any, ...], fd: int) -> None:
    from service.runtime import companion  # noqa: PLC0415

    try:
        companion._begin(given[0], given[1], given[2], Connection(fd))
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    os._exit(1)
