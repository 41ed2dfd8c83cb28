"""The start of a service of two planes: listeners, shared memory, and the supervisor of all processes."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import sys
from pathlib import Path

from service.api.server.sockets import UnixSocket, open_port
from service.foundation.settings import Settings
from service.planes import control, data
from service.planes.preparation import share_memory
from service.planes.pulse import Plane, Pulse
from service.planes.supervisor import STOPS, Child, Supervisor
from service.runtime import forking
from service.runtime.allocator import limit_heaps
from service.storage.storage import check_home


def serve(settings: Settings) -> None:
    """Serve until a signal. Raise HomeError, SocketError or ThreadsError; exit with the code of a failed start."""
    forking.call(check_home, settings)
    with open_port(settings.host, settings.port) as listener:
        unix = None if settings.uds is None else UnixSocket(settings.uds, settings.uds_mode)
        try:
            ending = _supervise(settings, listener, unix)
        finally:
            if unix is not None:
                unix.close()
    if ending < 0:  # as of a process without a handler; the first process of a container ends with 0
        signal.signal(-ending, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
        signal.raise_signal(-ending)
    elif ending:
        sys.exit(ending)


def _supervise(settings: Settings, listener: socket.socket, unix: UnixSocket | None) -> int:
    """Fork the planes and look after them until a stop; see `Supervisor.run`."""
    limit_heaps()
    share_memory(settings)
    forking.check_threads()
    forking.adopt_orphans()
    pulse = Pulse()
    # no file: nothing is left over after a kill
    link, lock = Path(f"\0lipserve-{secrets.token_hex(16)}"), os.memfd_create("lipserve-lock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as accepting:
        accepting.bind(os.fspath(link))
        accepting.listen(8)

        def run_control() -> None:
            _close(listener, unix)
            control.run(settings, accepting, pulse)

        def run_data() -> None:
            accepting.close()
            data.run(settings, listener, unix, link, lock, pulse)

        children = [Child(Plane.CONTROL, run_control, "control")]
        children += [Child(Plane.DATA, run_data, "spare") for _ in range(2)]
        return Supervisor(children, pulse, lambda: _close(listener, unix)).run()


def _close(listener: socket.socket, unix: UnixSocket | None) -> None:
    listener.close()
    if unix is not None:
        unix.listener.close()
