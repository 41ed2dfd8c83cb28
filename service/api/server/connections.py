"""Connections: how many there may be, an end to those whose clients neither ask nor read, and the WebSocket's, which
also says when bytes arrived and why the service goes away."""

from __future__ import annotations

import asyncio
import fcntl
import json
import sys
import termios
from contextlib import suppress
from http import HTTPStatus
from time import perf_counter
from typing import Any, ClassVar

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn import _types as asgi
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import CloseCode
from websockets.protocol import State

from service.api.errors import refuse
from service.api.limits.requests import HEALTH, PATIENCE, ClientPatience
from service.api.server.room import Room
from service.foundation.errors import BusyError, ErrorBody, ErrorResponse
from service.foundation.settings import Settings

REFUSED = 64
"""Connections beyond the most there may be that are told so; others are closed without a word."""


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection, with limits. Times are looked at when something happens rarely, not with each request."""

    patience: ClassVar[ClientPatience]
    room: ClassVar[Room]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._head: asyncio.TimerHandle | None = None  # until when a request has to have come, line and headers
        self._unread: asyncio.TimerHandle | None = None  # until when the client has to have read something
        self._left, self._resumed = 0, False
        self._upgraded = False  # to a stream, which reads the socket from then on
        self._known: object = None
        self.peer: str | None = None
        self._overhead = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, unless there are too many connections, none of which gives way."""
        super().connection_made(transport)
        self.peer = self.room.peer(self.client)
        beyond, why = self.room.admit(self, self.connections)
        if beyond > REFUSED:
            transport.abort()
            return
        if beyond > 0:
            self.app = _Crowded(self.app, why)
            self.ws_protocol_class = None
        self._head = self.loop.call_later(self.patience.header_s, self._late)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self.room.gone(self)
        self._cancel_head()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes from the socket."""
        self._overhead += len(data)
        super().data_received(data)
        if self._upgraded:
            return
        cycle = self.cycle
        if cycle is None or cycle.response_complete:
            # part of a line and of headers, or what is left of a body that was refused
            if self._head is None and not self.transport.is_closing():
                self._head = self.loop.call_later(self.patience.header_s, self._late)
        else:
            if self._head is not None:
                self._cancel_head()
            if cycle is not self._known:
                self._known, self._overhead = cycle, 0
        if self._overhead > self.patience.header_bytes:
            self._too_long()

    def on_headers_complete(self) -> None:
        """Begin a request. Trailers, which httptools gives as headers, do not reach it."""
        if sum(name == b"host" for name, _ in self.headers) > 1:
            raise ValueError("several Host headers")  # httptools makes an answer of 400 of it
        self.room.busy(self)
        super().on_headers_complete()
        self.headers = list(self.headers)

    def on_body(self, body: bytes) -> None:
        """Take a piece of a body; beside bodies, as much again may come: lengths of their pieces."""
        self._overhead -= 2 * len(body)
        super().on_body(body)

    def on_response_complete(self) -> None:
        """Go on after an answer, which may not have left yet."""
        super().on_response_complete()
        unread = self.transport.get_write_buffer_size() > 0
        if unread and self._unread is None:
            self._watch_reading()
        if self.cycle.response_complete:  # else the next one waits already
            self.room.rest(self, unread)

    def leave(self) -> None:
        """Close at once, for one that may be about to ask."""
        self.transport.abort()

    def pause_writing(self) -> None:
        """Wait until the client reads on."""
        super().pause_writing()
        if self._unread is None:
            self._watch_reading()

    def resume_writing(self) -> None:
        """Write on."""
        self._resumed = True
        super().resume_writing()

    def handle_websocket_upgrade(self) -> None:
        """Leave the connection to a stream, which has limits of its own."""
        self._upgraded = True
        self._cancel_head()
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP."""
        self._say(HTTPStatus.BAD_REQUEST, "invalid_request", msg)

    def _unsupported_upgrade_warning(self) -> None:
        """Do not log, as often as clients like, what they would have liked to speak."""

    def _cancel_head(self) -> None:
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _late(self) -> None:
        """Close a connection on which no request came in time."""
        self._head = None
        if self.transport.is_closing():
            return
        if self._overhead > 0 and self.cycle is None:
            message = f"the request's line and headers did not come within {self.patience.header_s:g} s"
            self._say(HTTPStatus.REQUEST_TIMEOUT, "request_timeout", message)
        else:
            self.transport.close()

    def _too_long(self) -> None:
        """Close a connection whose headers, or those after a body, have no end."""
        if self.transport.is_closing():
            return
        if self.cycle is None or self.cycle.response_complete:
            message = f"the request's line and headers have more than {self.patience.header_bytes} bytes"
            self._say(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "too_large", message)
        else:
            self.transport.abort()

    def _watch_reading(self) -> None:
        self._left, self._resumed = self._waiting(), False
        self._unread = self.loop.call_later(self.patience.answer_s, self._look_reading)

    def _look_reading(self) -> None:
        """Give up a client that has read nothing for a while; look again at one that reads slowly."""
        self._unread = None
        if not self.transport.get_write_buffer_size():
            return
        if self._waiting() >= self._left and not self._resumed:
            self.transport.abort()
        else:
            self._watch_reading()

    def _waiting(self) -> int:
        """Bytes that the client has not taken: here, and in the kernel, whose buffers hide a slow reader for long."""
        waiting = self.transport.get_write_buffer_size()
        with suppress(OSError, ValueError):  # a kernel that does not tell, a socket that is closed
            number = self.transport.get_extra_info("socket").fileno()
            waiting += int.from_bytes(fcntl.ioctl(number, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
        return waiting

    def _say(self, status: HTTPStatus, code: str, message: str) -> None:
        """Answer what did not become a request, and close."""
        body = ErrorResponse(error=ErrorBody(code=code, message=message)).model_dump()
        content = json.dumps(body).encode()
        head = b"content-type: application/json\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(content)
        self.transport.write(STATUS_LINE[status] + head + content)
        self.transport.close()


class _Crowded:
    """What answers on a connection that is one too many: health as always, anything else with 429."""

    def __init__(self, app: ASGIApp, why: str) -> None:
        self.app, self.why = app, why

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"].startswith(HEALTH):
            await self.app(scope, receive, send)
            return
        headers = {"Retry-After": "1", "Connection": "close"}
        await refuse(BusyError(f"{self.why}: try again", headers=headers), scope, receive, send)


def guarded(settings: Settings, patience: ClientPatience = PATIENCE) -> type[GuardedProtocol]:
    """Class of connections with the limits of the settings, for `uvicorn.Config(http=...)`."""
    return type("GuardedProtocol", (GuardedProtocol,), {"patience": patience, "room": Room(settings)})


CONNECTION = "lipserve.connection"
"""Key of the connection in the `state` of an ASGI scope."""
MAX_FRAME_BYTES = 64 * 1024
"""Largest frame that a stream reads."""


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

    async def _run(self, scope: asgi.Scope, receive: asgi.ASGIReceiveCallable, send: asgi.ASGISendCallable) -> None:
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

    def send_receive_event_to_app(self) -> None:
        """Hand on a message; a text that is none ends the stream, and is not logged: clients may send any number."""
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
        self.close_timer = self.loop.call_later(3.0, self.transport.abort)  # for the client to answer the close

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
        self.loop.call_later(1.0, self.transport.abort)
