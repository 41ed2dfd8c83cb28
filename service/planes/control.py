"""The control plane's end: it publishes what answers, and does what the data plane asks for."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from pickle import PickleBuffer
from typing import Any

from fastapi import FastAPI

from service.api.server import sockets
from service.foundation.errors import ServiceError
from service.learning.ingest.frames import Frames
from service.learning.learners import Learners
from service.models.loaded import LoadedModels
from service.planes.channel import Channel
from service.planes.handover import ControlProtocol, adopt
from service.planes.publisher import Publisher

logger = logging.getLogger(__name__)


class ControlServer(sockets.Server):
    """uvicorn's server without a port: its connections come from the data plane."""

    app: FastAPI
    link: socket.socket

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the application, then accept data planes."""
        await super().startup([])
        self._loop = asyncio.get_running_loop()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            connection, _ = self.link.accept()
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
