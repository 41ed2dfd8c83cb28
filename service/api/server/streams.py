"""WebSocket connections of uvicorn: when a message arrived, and how they end."""

from __future__ import annotations

import asyncio
from time import perf_counter
from typing import Any

from uvicorn import _types as asgi
from uvicorn.config import Config
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import CloseCode
from websockets.protocol import State

CONNECTION = "lipserve.connection"
"""Key of the connection in the `state` of an ASGI scope."""
MAX_FRAME_BYTES = 64 * 1024
"""Max size of a frame that a stream reads."""


class StreamProtocol(WebSocketsSansIOProtocol):
    """One WebSocket connection, for `uvicorn.run(ws=StreamProtocol)`.

    uvicorn stops reading while a message waits for the application, so all waiting messages arrived together. `arrived`
    is their time of arrival, in seconds of `time.perf_counter`.
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

    async def _run(self, scope: asgi.Scope, receive: asgi.ASGIReceiveCallable, send: asgi.ASGISendCallable) -> None:
        try:
            await self._application(scope, receive, send)
        finally:  # no reference cycles: objects that exist when a model loads are frozen and not garbage-collected
            self.app_state.pop(CONNECTION, None)
            self.scope["state"].pop(CONNECTION, None)
            self.app = self._application
        if self.initial_response is not None:
            self.handshake_complete = True  # else uvicorn logs the refused handshake as still open

    def data_received(self, data: bytes) -> None:
        """Handle bytes from the socket."""
        self.arrived = perf_counter()
        super().data_received(data)

    def send_receive_event_to_app(self) -> None:
        """Pass a message on. A text that is not UTF-8 ends the stream, without a log line per text."""
        if self.curr_msg_data_type == "text" and not self.close_sent:
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self.frames = []
                if self.handshake_complete:
                    self.end(CloseCode.INVALID_DATA, "a text message is not UTF-8")
                else:
                    self.abort()
                return
        super().send_receive_event_to_app()

    def abort(self) -> None:
        """Close at once, with unsent data: for a client that does not read."""
        self.transport.abort()

    def end(self, code: int, reason: str) -> None:
        """Close while the client is sending. Its messages are dropped until it answers the close."""
        if not self.handshake_complete or self.close_sent or self.conn.state is not State.OPEN:
            return
        self.stop_keepalive()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})
        self.conn.send_close(code, reason)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = self.disconnected = True  # further sends of the application fail
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()
        self.close_timer = self.loop.call_later(3.0, self.transport.abort)  # for the client to answer the close

    def shutdown(self) -> None:
        """Close because the server stops, with 1001 "going away" instead of uvicorn's 1012 "service restart"."""
        if self.handshake_complete and self.conn.state is State.OPEN:
            self.stop_keepalive()
            self.queue.put_nowait({"type": "websocket.disconnect", "code": int(CloseCode.GOING_AWAY)})
            self.conn.send_close(CloseCode.GOING_AWAY, "the service stops")
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.transport.close()
        elif not self.handshake_complete or self.close_sent:
            super().shutdown()
        # a client that does not read would keep the server from ending
        self.loop.call_later(1.0, self.transport.abort)
