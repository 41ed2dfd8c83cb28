"""The sockets of the service: a TCP port and an optional Unix-domain socket."""

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

BACKLOG, PORT_BACKLOG = 128, 2048
"""Connections that wait to be accepted, of a Unix-domain socket and of a port (uvicorn's default)."""
DRAIN_S = 5
"""Max wait in s for running requests when the service stops."""


class SocketError(OSError):
    """The port or socket cannot be opened."""


def check_port(host: str, port: int) -> None:
    """Check that the port is free; raise SocketError."""
    open_port(host, port).close()


def open_port(host: str, port: int) -> socket.socket:
    """Return a listening socket; raise SocketError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=PORT_BACKLOG)
    except OSError as error:
        reason = error.strerror or str(error)
        message = f"Cannot listen on port {port} of {host}: {reason}. Set another --port, or 0 for any free port."
        raise SocketError(message) from error


class UnixSocket:
    """A listening Unix-domain socket. Clients that connect before the service has started wait.

    A socket file left by a dead service is replaced. Raise SocketError if another service listens at the path, if the
    path is not a socket, or if no socket can be created there.
    """

    def __init__(self, path: Path, mode: int) -> None:
        self.path = path
        _remove_stale(path)
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.listener.bind(os.fspath(path))
        except OSError as error:  # missing folder, missing permission, path too long
            self.listener.close()
            reason = error.strerror or str(error)
            raise SocketError(f"Cannot create the socket {str(path)!r}: {reason}") from error
        self._identity = _identity(path)
        path.chmod(mode)  # nobody can connect before it listens
        self.listener.listen(BACKLOG)

    def remove(self) -> None:
        """Remove the file, unless it has been replaced by another."""
        if _identity(self.path) == self._identity:
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Stop listening and remove the file."""
        self.remove()
        self.listener.close()


class Server(uvicorn.Server):
    """uvicorn's server, listening on both a port and a Unix-domain socket.

    After the first stop signal it reports "not ready" for `notice_s`, then closes its listeners and finishes running
    requests. A second signal ends it at once.
    """

    def __init__(self, config: uvicorn.Config, unix: UnixSocket | None, stopping: StopState, notice_s: float) -> None:
        super().__init__(config)
        self.unix, self.stopping, self.notice_s = unix, stopping, notice_s

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen on the port as usual, and on the socket."""
        await super().startup(sockets)
        if self.unix is None:
            return
        made: Any = self.config.http_protocol_class  # uvicorn's type lacks the arguments
        protocol = functools.partial(
            made, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        loop = asyncio.get_running_loop()
        # shutdown closes all of `servers`
        self.servers.append(await loop.create_unix_server(protocol, sock=self.unix.listener, backlog=BACKLOG))
        logger.info("listening on the Unix-domain socket %s", self.unix.path)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Report "not ready" for `notice_s`, remove the socket, and stop as usual."""
        self.stopping.begun = True
        if self.notice_s:
            logger.info("stopping in %g s; not ready, but still answering", self.notice_s)
            await asyncio.sleep(self.notice_s)
        self.stopping.closing.set()
        if self.unix is not None:
            self.unix.remove()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop at the first signal, exit at the second. Acknowledged data are already durable."""
        if self.should_exit:
            if self.unix is not None:
                self.unix.remove()
            signal.signal(sig, signal.SIG_DFL)
            signal.raise_signal(sig)
        super().handle_exit(sig, frame)


def serve(config: uvicorn.Config, uds: Path | None, mode: int, stopping: StopState, notice_s: float = 0.0) -> None:
    """Serve on the port of the config and on a socket at the path `uds`, until a signal stops the service.

    It still answers for `notice_s` after the signal, while `stopping` reports it. Raise SocketError before anything
    starts; exit the process if the start fails.
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


def _remove_stale(path: Path) -> None:
    """Remove the socket of a dead service; raise SocketError if anything else is at the path."""
    try:
        kind = path.lstat().st_mode
    except OSError:  # nothing there, or no folder, which bind reports
        return
    if not stat.S_ISSOCK(kind):
        raise SocketError(f"{str(path)!r} exists and is not a socket. Set another path.")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        code = probe.connect_ex(os.fspath(path))
    if code == errno.ECONNREFUSED:
        path.unlink(missing_ok=True)
    elif code in (0, errno.EAGAIN):
        raise SocketError(f"Another service listens at {str(path)!r}. Stop it, or set another path.")
    else:
        reason = os.strerror(code)
        raise SocketError(f"The socket {str(path)!r} does not answer: {reason}. Set another path.")


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
