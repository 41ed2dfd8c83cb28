"""uvicorn's WebSocket connection, which also says when bytes arrived and why the service goes away."""

from __future__ import annotations

import asyncio
from time import perf_counter
from typing import Any

from uvicorn._types import ASGIReceiveCallable, ASGISendCallable, Scope
from uvicorn.config import Config
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import CloseCode
from websockets.protocol import State

CONNECTION = "lipserve.connection"
"""Key of the connection in the `state` of an ASGI scope."""
FLUSH_SECONDS = 1.0
CLOSE_SECONDS = 3.0
"""How long a client may take to answer a close before it is cut off."""


class StreamProtocol(WebSocketsSansIOProtocol):
    """For `uvicorn.run(ws=StreamProtocol)`: one WebSocket connection.

    While a message waits for the application, uvicorn does not read on; so all messages that wait arrived together, and
    `arrived` is when, in seconds of `time.perf_counter`.
    """

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, {**app_state, CONNECTION: self}, _loop)
        self.arrived = 0.0
        self._application, self.app = self.app, self._run

    async def _run(self, scope: Scope, receive: ASGIReceiveCallable, send: ASGISendCallable) -> None:
        try:
            await self._application(scope, receive, send)
        finally:  # no cycles: what exists when a model is loaded is frozen, and freed only where nothing refers to it
            self.app_state.pop(CONNECTION, None)
            self.scope["state"].pop(CONNECTION, None)
            self.app = self._application
        if self.initial_response is not None:
            self.handshake_complete = True  # by a refusal, which uvicorn would log as a handshake left open

    def data_received(self, data: bytes) -> None:
        """Take bytes from the socket."""
        self.arrived = perf_counter()
        super().data_received(data)

    def abort(self) -> None:
        """Close at once, whatever is still to be written: for a client that does not read."""
        self.transport.abort()

    def end(self, code: int, reason: str) -> None:
        """Close although the client goes on asking: what it sends is dropped until it has answered the close."""
        if not self.handshake_complete or self.close_sent or self.conn.state is not State.OPEN:
            return
        self.stop_keepalive()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})
        self.conn.send_close(code, reason)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = self.disconnected = True  # nothing is sent any more: the application learns so when it tries
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()
        self.close_timer = self.loop.call_later(CLOSE_SECONDS, self.transport.abort)

    def shutdown(self) -> None:
        """Close because the server stops: 1001, "going away", where uvicorn says 1012, "service restart"."""
        if self.handshake_complete and self.conn.state is State.OPEN:
            self.stop_keepalive()
            self.queue.put_nowait({"type": "websocket.disconnect", "code": int(CloseCode.GOING_AWAY)})
            self.conn.send_close(CloseCode.GOING_AWAY, "the service stops")
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.transport.close()
        elif not self.handshake_complete or self.close_sent:
            super().shutdown()
        # a client that does not read would keep the server from ending
        self.loop.call_later(FLUSH_SECONDS, self.transport.abort)
