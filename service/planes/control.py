"""The control plane's end: it publishes what answers, and does what the data plane asks for."""

from __future__ import annotations

import socket
import threading

from fastapi import FastAPI

from service.api.server import sockets
from service.planes.channel import Channel
from service.planes.dataplanes import DataPlanes


class ControlServer(sockets.Server):
    """uvicorn's server without a port: its connections come from the data plane."""

    app: FastAPI
    link: socket.socket

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the application, then accept data planes."""
        await super().startup([])
        self._planes = DataPlanes(self.app, self)
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            connection, _ = self.link.accept()
            self._planes.add(Channel(connection))
