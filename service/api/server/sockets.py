"""Where the service listens: the TCP port and, if it is asked for, a Unix-domain socket beside it."""

from __future__ import annotations

import asyncio
import errno
import functools
import logging
import os
import signal
import socket
import stat
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from uvicorn.config import STARTUP_FAILURE

from service.telemetry.readiness import StopState

logger = logging.getLogger(__name__)

BACKLOG = 128
DRAIN_S = 5
"""Longest wait in s for answers in progress when the service stops."""


class SocketError(OSError):
    """There can be no socket at the path; the message says why and what would do."""


def check_port(host: str, port: int) -> None:
    """Look before the service starts whether it can listen at an address; raise SocketError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        reason = error.strerror or str(error)
        expected = f"one that is free at {host}: {reason}; --port names another, 0 takes any"
        raise SocketError(f"port is {port}, expected {expected}") from error


class UnixSocket:
    """A listening socket in the file system; who connects before the service has started waits for it.

    The file that a dead service left is replaced. Raise SocketError where a live one listens, where anything but a
    socket lies at the path, or where there can be none.
    """

    def __init__(self, path: Path, mode: int) -> None:
        self.path = path
        _make_room(path)
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.listener.bind(os.fspath(path))
        except OSError as error:  # no such folder, no right to write in it, a path too long
            self.listener.close()
            reason = error.strerror or str(error)
            raise SocketError(f"uds is {str(path)!r}, expected a path where a socket can be made: {reason}") from error
        self._identity = _identity(path)
        path.chmod(mode)  # nobody can connect before it listens
        self.listener.listen(BACKLOG)

    def remove(self) -> None:
        """Remove the file, unless another one has taken its place."""
        if _identity(self.path) == self._identity:
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Stop listening and remove the file."""
        self.remove()
        self.listener.close()


class Server(uvicorn.Server):
    """uvicorn's server with a second listener, which of itself takes a port or a socket, not both.

    Told to stop, it first says so for `notice_s`, then takes no more connections and finishes what it has begun. Told a
    second time, it ends at once.
    """

    def __init__(self, config: uvicorn.Config, unix: UnixSocket | None, stopping: StopState, notice_s: float) -> None:
        super().__init__(config)
        self.unix, self.stopping, self.notice_s = unix, stopping, notice_s

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen on the port as usual, and on the socket."""
        await super().startup(sockets)
        if self.unix is None:
            return
        made: Any = self.config.http_protocol_class  # uvicorn's type of it says nothing of its arguments
        protocol = functools.partial(
            made, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        loop = asyncio.get_running_loop()
        # among the servers that shutdown closes
        self.servers.append(await loop.create_unix_server(protocol, sock=self.unix.listener, backlog=BACKLOG))
        logger.info("listening on the Unix-domain socket %s", self.unix.path)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Give notice, remove the socket, and stop as usual: the signal that stops uvicorn ends the process after."""
        self.stopping.begun = True
        if self.notice_s:
            logger.info("stopping in %g s: no longer ready, but still answering", self.notice_s)
            await asyncio.sleep(self.notice_s)
        self.stopping.closing.set()
        if self.unix is not None:
            self.unix.remove()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at the first signal, end at the second: what is durable is so already."""
        if self.should_exit:
            if self.unix is not None:
                self.unix.remove()
            signal.signal(sig, signal.SIG_DFL)
            signal.raise_signal(sig)
        super().handle_exit(sig, frame)


def serve(config: uvicorn.Config, uds: Path | None, mode: int, stopping: StopState, notice_s: float = 0.0) -> None:
    """Serve until a signal comes, on the port of the config and on a socket at the path `uds`.

    notice_s: how long it still answers after the signal, while `stopping` says that it was told. Raise SocketError
    before anything starts; end the process where the start fails.
    """
    unix = None if uds is None else UnixSocket(uds, mode)
    server = Server(config, unix, stopping, notice_s)
    try:
        server.run()
    except KeyboardInterrupt:
        pass
    finally:
        if unix is not None:
            unix.close()
    if not server.started:
        sys.exit(STARTUP_FAILURE)


def _make_room(path: Path) -> None:
    """Remove what a dead service left at the path; raise SocketError for anything else there."""
    try:
        kind = path.lstat().st_mode
    except OSError:  # nothing, or no folder: binding says
        return
    if not stat.S_ISSOCK(kind):
        raise SocketError(f"uds is {str(path)!r}, where something lies that is no socket: expected another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        code = probe.connect_ex(os.fspath(path))
    if code == errno.ECONNREFUSED:
        path.unlink(missing_ok=True)
    elif code in (0, errno.EAGAIN):
        raise SocketError(f"uds is {str(path)!r}, where another service listens: stop it, or set another path")
    else:
        reason = os.strerror(code)
        raise SocketError(f"uds is {str(path)!r}, where a socket lies that does not answer: {reason}; set another path")


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
