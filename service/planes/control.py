"""The control plane's end: it publishes what answers, and does what the data plane asks for."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import replace
from pickle import PickleBuffer
from types import FrameType
from typing import Any

from fastapi import FastAPI

from service.api.server import sockets
from service.api.server.configuration import configure_server
from service.app import create_app
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.learning.ingest.frames import Frames
from service.learning.learners import Learners
from service.models.loaded import LoadedModels
from service.planes.channel import Channel
from service.planes.handover import ControlProtocol, adopt
from service.planes.publisher import Publisher
from service.planes.pulse import BEAT_S, Plane, Pulse
from service.runtime import nursery
from service.runtime.allocator import limit_free_memory

logger = logging.getLogger(__name__)


def run(settings: Settings, link: socket.socket, pulse: Pulse) -> None:
    """Serve all routes to the data planes that connect to `link`, until SIGTERM."""
    nursery.start()
    multiprocessing.current_process().name = "MainProcess"  # the log does not mention it
    limit_free_memory()
    app = create_app(settings)
    ControlServer(app, settings, link, pulse).run()


class ControlServer(sockets.Server):
    """uvicorn's server without a port: its connections come from the data plane.

    The supervisor sends SIGUSR1 when the service begins to stop, and SIGTERM once the data plane has ended.
    """

    def __init__(self, app: FastAPI, settings: Settings, link: socket.socket, pulse: Pulse) -> None:
        super().__init__(configure_server(app, settings), None, app.state.stopping, notice_s=0.0)
        self.app, self.link, self._pulse = app, link, pulse

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the application, then accept data planes."""
        await super().startup([])
        self.app.state.readiness.add("planes", self._pulse.check)
        self._loop = asyncio.get_running_loop()
        self._loop.add_signal_handler(signal.SIGUSR1, self._announce_stop)
        self._beat()
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
            connection, _ = self.link.accept()
            if not is_own(connection):
                connection.close()
                continue
            channel = Channel(connection)
            Publisher(self.app, channel).start()
            threading.Thread(target=self._receive, args=(channel,), daemon=True).start()

    def _receive(self, channel: Channel) -> None:
        learners: Learners = self.app.state.learners
        while (received := channel.receive()) is not None:
            (kind, *given), fds = received
            if kind == "connection":
                asyncio.run_coroutine_threadsafe(adopt(fds[0], self._protocol(channel, bytes(given[0]))), self._loop)
            elif kind == "load":
                threading.Thread(target=_load, args=(learners.loaded, *given), daemon=True).start()
            elif kind == "frames":
                asyncio.run_coroutine_threadsafe(_log(learners, channel, *given), self._loop)
            elif kind == "meters":
                self.app.state.data_meters = given[0]

    def _protocol(self, channel: Channel, first: bytes) -> Callable[[], asyncio.Protocol]:
        def send(fd: int, data: bytes) -> bool:
            return channel.send(("connection", PickleBuffer(data)), [fd], wait=False)

        base: Any = self.config.http_protocol_class
        kind: Any = type("ControlConnection", (ControlProtocol,), {"send": staticmethod(send), "first": first})
        kind.patience, kind.limit = base.patience, base.limit
        return lambda: kind(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)


def is_own(connection: socket.socket) -> bool:
    """Return whether the process at the other end of a Unix-domain socket has the user of this one."""
    _, user, _ = struct.unpack(
        "3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    )
    return bool(user == os.getuid())


def _load(loaded: LoadedModels, model: str, version: int | None, alias: str | None) -> None:
    try:
        loaded.get(model, version, alias)
    except ServiceError:
        logger.debug("model %s cannot be loaded for the data plane", model)


async def _log(learners: Learners, channel: Channel, number: int, frames: Frames, version: int, revision: int) -> None:
    """Log frames and reply once they are durable."""
    try:
        served = await asyncio.to_thread(learners.loaded.get, frames.model, version)
        if served.revision != revision:
            served = replace(served, revision=revision)
        given = replace(frames, served=served)
        result: Any = await learners.threads.run(frames.model, learners.observe_frames, given)
    except ServiceError as error:
        result = error
    except Exception as error:
        logger.exception("frames could not be learnt")
        result = ServiceError(str(error))
    await asyncio.to_thread(channel.send, ("logged", number, result))
