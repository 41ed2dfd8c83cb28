"""The process of the control plane: it answers all routes, and publishes what answers to the data plane."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import socket
import struct
import threading
from types import FrameType

from fastapi import FastAPI

from service.api.server import sockets
from service.api.server.configuration import configure_server
from service.app import create_app
from service.foundation.settings import Settings
from service.planes.confirmations import confirm_answers
from service.planes.dataplanes import DataPlanes
from service.planes.inheritance import CONTROL_PART, Inheritance
from service.planes.pulse import BEAT_S, Plane, Pulse
from service.planes.workers.pool import WorkerPool
from service.runtime import nursery
from service.runtime.allocator import limit_free_memory
from service.runtime.channel import Channel, share


def run(inherited: Inheritance) -> None:
    """Serve all routes to the data planes that connect, until SIGTERM."""
    inherited.close_listeners()
    forks = nursery.start()
    multiprocessing.current_process().name = "MainProcess"  # the log does not mention it
    limit_free_memory()
    app = create_app(inherited.settings, inherited.memory.join(CONTROL_PART), share)
    app.state.workers = WorkerPool(inherited.settings, forks.start)
    confirm_answers(app)
    ControlServer(app, inherited.settings, inherited.accepting, inherited.pulse).run()


class ControlServer(sockets.Server):
    """uvicorn's server without a port: its connections come from the data plane.

    The supervisor sends SIGUSR1 when the service begins to stop, and SIGTERM once the data plane has ended.
    """

    def __init__(self, app: FastAPI, settings: Settings, link: socket.socket, pulse: Pulse) -> None:
        super().__init__(configure_server(app, settings), None, app.state.stopping, notice_s=0.0)
        self.app, self._link, self._pulse = app, link, pulse

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the application, then accept data planes."""
        await super().startup([])
        self.app.state.readiness.add("planes", self._pulse.check)
        self._loop = asyncio.get_running_loop()
        self._loop.add_signal_handler(signal.SIGUSR1, self._announce_stop)
        self._beat()
        self._planes = DataPlanes(self.app, self)
        threading.Thread(target=self._accept, daemon=True).start()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop. A second signal changes nothing: the supervisor kills this process."""
        self.should_exit = True

    def _announce_stop(self) -> None:
        self.stopping.begun = True

    def _beat(self) -> None:
        self._pulse.beat(Plane.CONTROL)
        self._loop.call_later(BEAT_S, self._beat)

    def _accept(self) -> None:
        while True:
            connection, _ = self._link.accept()
            if is_own(connection):
                self._planes.add(Channel(connection))
            else:
                connection.close()


def is_own(connection: socket.socket) -> bool:
    """Return whether the process at the other end of a Unix-domain socket has the user of this one."""
    format_ = "3i"  # process, user, group
    found = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize(format_))
    return bool(struct.unpack(format_, found)[1] == os.getuid())
