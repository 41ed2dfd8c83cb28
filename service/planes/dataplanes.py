"""The control plane's ends of the channels to the data planes."""

from __future__ import annotations

import asyncio
import logging
import threading
from functools import partial
from typing import Any

from fastapi import FastAPI
from uvicorn.server import Server

from service.api.server.connections import guarded
from service.learning.learners import Learners
from service.planes.connections import ControlProtocol
from service.planes.counting import AdoptedConnections, ShedConnection
from service.planes.frames import FramesLogged, FramesToLog, log_frames
from service.planes.handover import Handed, adopt, pass_on
from service.planes.publications import Answering, Confirmed, Holdings, LearnerWake, LoadRequest, VersionUse
from service.planes.publisher import Publisher
from service.runtime.channel import Channel

logger = logging.getLogger(__name__)


class DataPlanes:
    """The data planes: the one that answers, its spare, and those that came before. Make it in the event loop.

    server: serves the connections that they pass on.
    """

    def __init__(self, app: FastAPI, server: Server) -> None:
        self._app, self._server, self._loop = app, server, asyncio.get_running_loop()
        self._channels: set[Channel] = set()
        self._answering: Channel | None = None
        kind = guarded(app.state.storage.settings, kind=ControlProtocol, data=self._pass_back)
        self._protocol = partial(
            kind, config=server.config, server_state=server.server_state, app_state=server.lifespan.state
        )
        self._connections = AdoptedConnections(kind.limit, server.server_state.connections, self._broadcast)
        self._publisher = Publisher(app.state.loaded, app.state.keyring, app.state.confirmations)
        app.state.confirmations.watch(app.state.loaded.changes)
        self._publisher.start()
        self._reporting = self._loop.create_task(self._connections.report())

    def add(self, channel: Channel) -> None:
        """Publish to a data plane and do what it asks for, until it is gone. From any thread."""
        self._loop.call_soon_threadsafe(self._join, channel)
        threading.Thread(target=self._receive, args=(channel,), daemon=True, name="data plane").start()

    def close(self) -> None:
        """Stop publishing and reporting, and close the channels."""
        self._publisher.close()
        self._reporting.cancel()
        for channel in tuple(self._channels):
            channel.close()

    def _receive(self, channel: Channel) -> None:
        while (received := channel.receive()) is not None:
            try:
                self._handle(channel, *received)
            except Exception:
                logger.exception("could not handle a message of the data plane")
        self._publisher.unsubscribe(channel)
        self._loop.call_soon_threadsafe(self._leave, channel)

    def _join(self, channel: Channel) -> None:
        self._channels.add(channel)
        channel.send(self._connections.sent, wait=False)

    def _leave(self, channel: Channel) -> None:
        self._channels.discard(channel)
        if self._answering is channel:
            self._answering, self._connections.through = None, 0
        channel.close()

    def _handle(self, channel: Channel, message: Any, fds: list[int]) -> None:
        learners: Learners = self._app.state.learners
        match message:
            case Handed():
                asyncio.run_coroutine_threadsafe(self._adopt(channel, message, fds[0]), self._loop)
            case FramesToLog():
                asyncio.run_coroutine_threadsafe(self._log(learners, channel, message), self._loop)
            case ShedConnection():
                self._loop.call_soon_threadsafe(self._shed, channel, message)
            case Holdings():
                self._publisher.subscribe(channel, message)
            case Answering() | Confirmed() | LoadRequest() | VersionUse():
                self._publisher.receive(channel, message)
            case LearnerWake(model):
                learners.loaded.wake(model)

    async def _adopt(self, channel: Channel, handed: Handed, fd: int) -> None:
        self._answering = channel
        self._connections.through = handed.number
        await adopt(fd, partial(self._protocol, handed=handed))

    def _pass_back(self, transport: asyncio.Transport, handed: Handed, peer: str | None) -> bool:
        channel = self._answering
        if channel is None:
            return False
        return pass_on(transport, handed, lambda fd, message: channel.send(message, [fd], wait=False))

    def _shed(self, channel: Channel, asked: ShedConnection) -> None:
        channel.send(self._connections.shed(asked), wait=False)

    def _broadcast(self, message: Any) -> None:
        for channel in tuple(self._channels):
            channel.send(message, wait=False)

    async def _log(self, learners: Learners, channel: Channel, message: FramesToLog) -> None:
        """Log frames; acknowledge them after the publication of what they have changed."""
        logged = await log_frames(learners, message)
        await asyncio.to_thread(self._publish_and_send, channel, logged)

    def _publish_and_send(self, channel: Channel, message: FramesLogged) -> None:
        self._publisher.publish()
        channel.send(message)
