"""What the processes of both planes inherit from the supervisor that forks them."""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from service.api.server.sockets import UnixSocket, open_port
from service.api.shared import SharedMemory
from service.foundation.settings import Settings
from service.planes.pulse import Pulse

CONTROL_PART, DATA_PARTS = 0, (1, 2)
"""Parts of the shared memory: of the control plane, and of the two processes of the data plane."""
BACKLOG = 8


@dataclass(frozen=True)
class Inheritance:
    """Listeners, memory and locks of a service.

    - port, unix: listeners for clients.
    - link, accepting: address at which data planes reach the control plane, and its listener. The address is no file:
      nothing is left over after a kill.
    - lock: descriptor of a file without a name. The data plane that answers has locked it. The kernel unlocks it when
      that process ends.
    """

    settings: Settings
    port: socket.socket
    unix: UnixSocket | None
    link: Path
    accepting: socket.socket
    lock: int
    pulse: Pulse
    memory: SharedMemory

    def close_listeners(self) -> None:
        """Close this process's copies of the listeners for clients."""
        self.port.close()
        if self.unix is not None:
            self.unix.listener.close()


@contextmanager
def inheritance(settings: Settings) -> Iterator[Inheritance]:
    """Open what the processes of a service inherit. Raise SocketError."""
    with ExitStack() as stack:
        port = stack.enter_context(open_port(settings.host, settings.port))
        unix = None if settings.uds is None else UnixSocket(settings.uds, settings.uds_mode)
        if unix is not None:
            stack.callback(unix.close)
        link = Path(f"\0lipserve-{secrets.token_hex(16)}")
        accepting = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        accepting.bind(os.fspath(link))
        accepting.listen(BACKLOG)
        lock = os.memfd_create("lipserve-lock")
        stack.callback(os.close, lock)
        # gRPC needs a file
        folder = "/nonexistent" if settings.grpc_port is None else stack.enter_context(TemporaryDirectory("-lipserve"))
        memory = SharedMemory(1 + len(DATA_PARTS), settings, Path(folder) / "calls")
        yield Inheritance(settings, port, unix, link, accepting, lock, Pulse(), memory)
