"""HTTP connections of uvicorn, with limits on their number and on idle or slow clients."""

from __future__ import annotations

import asyncio
import fcntl
import json
import sys
import termios
from contextlib import suppress
from http import HTTPStatus
from typing import Any, ClassVar, TypeVar

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from service.api.errors import refuse
from service.api.limits.requests import HEALTH, PATIENCE, ClientPatience
from service.api.server.connection_limit import ConnectionLimit, Excess, OtherConnections
from service.foundation.errors import BusyError, ErrorBody, ErrorResponse
from service.foundation.settings import Settings

MAX_REFUSED_CONNECTIONS = 64
"""Connections beyond the limit that are answered with 429; further ones are closed without an answer."""


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection, with limits. Its timers are set on rare events, not with every request."""

    patience: ClassVar[ClientPatience]
    limit: ClassVar[ConnectionLimit]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._head: asyncio.TimerHandle | None = None  # deadline for the request line and headers
        self._unread: asyncio.TimerHandle | None = None  # deadline for the client to read something
        self._left, self._resumed = 0, False
        self._upgraded = False  # to a stream, which then reads the socket
        self._known: object = None
        self.peer: str | None = None
        self.refused = ""  # why requests are answered with 429, if they are
        self._overhead = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection, or refuse it if there are too many and none is idle."""
        super().connection_made(transport)
        self.peer = self.limit.find_peer(self.client)
        excess = self.admit()
        if excess.number > MAX_REFUSED_CONNECTIONS:
            transport.abort()
            return
        if excess.number > 0:
            self.exceed(excess)
        self._watch_head()

    def admit(self) -> Excess:
        """Make room for this connection; see `ConnectionLimit.admit`."""
        return self.limit.admit(self, self.connections)

    def exceed(self, excess: Excess) -> None:
        """Act on a limit that this connection exceeds."""
        self.refuse_requests(excess.why)

    def refuse_requests(self, why: str) -> None:
        """Answer all requests but health with 429."""
        self.refused, self.app, self.ws_protocol_class = why, _Refusing(self.app, why), None

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection and its timers."""
        self.limit.remove(self)
        self._cancel_head()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Handle bytes from the socket."""
        self._overhead += len(data)
        super().data_received(data)
        if self._upgraded:
            return
        cycle = self.cycle
        if cycle is None or cycle.response_complete:
            # part of a request line and headers, or the rest of a rejected body
            self._watch_head()
        else:
            if self._head is not None:
                self._cancel_head()
            if cycle is not self._known:
                self._known, self._overhead = cycle, 0
        if self._overhead > self.patience.header_bytes:
            self._too_long()

    def on_headers_complete(self) -> None:
        """Start a request. Trailers, which httptools reports as headers, are ignored."""
        if sum(name == b"host" for name, _ in self.headers) > 1:
            raise ValueError("several Host headers")  # httptools answers 400
        self.limit.mark_busy(self)
        super().on_headers_complete()
        self.headers = list(self.headers)

    def on_body(self, body: bytes) -> None:
        """Handle a piece of a body; it allows as many bytes of chunk lengths besides."""
        self._overhead -= 2 * len(body)
        super().on_body(body)

    def on_response_complete(self) -> None:
        """Mark the connection idle after an answer, which may not have been sent completely."""
        super().on_response_complete()
        unread = self.transport.get_write_buffer_size() > 0
        if unread and self._unread is None:
            self._watch_reading()
        if self.cycle.response_complete:  # else the next request has begun
            self.limit.mark_idle(self, unread)

    def drop(self) -> None:
        """Close at once, to make room for a new connection."""
        self.transport.abort()

    def pause_writing(self) -> None:
        """Stop writing until the client reads."""
        super().pause_writing()
        if self._unread is None:
            self._watch_reading()

    def resume_writing(self) -> None:
        """Resume writing."""
        self._resumed = True
        super().resume_writing()

    def handle_websocket_upgrade(self) -> None:
        """Hand the connection over to a stream, which has its own limits."""
        self._upgraded = True
        self._cancel_head()
        super().handle_websocket_upgrade()
        self.parser: Any = None  # no reference cycle, as in uvicorn's `connection_lost`

    def send_400_response(self, msg: str) -> None:
        """Answer bytes that are not HTTP."""
        self._refuse(HTTPStatus.BAD_REQUEST, "invalid_request", msg)

    def _unsupported_upgrade_warning(self) -> None:
        """Log nothing: clients could fill the log."""

    def _watch_head(self) -> None:
        if self._head is None and not self.transport.is_closing():
            self._head = self.loop.call_later(self.patience.header_s, self._late)

    def _cancel_head(self) -> None:
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _late(self) -> None:
        """Close a connection without a request in time."""
        self._head = None
        if self.transport.is_closing():
            return
        if self._overhead > 0 and self.cycle is None:
            message = f"The request line and headers did not arrive within {self.patience.header_s:g} s."
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, "request_timeout", message)
        else:
            self.transport.close()

    def _too_long(self) -> None:
        """Close a connection with too long headers or trailers."""
        if self.transport.is_closing():
            return
        if self.cycle is None or self.cycle.response_complete:
            message = f"The request line and headers have more than {self.patience.header_bytes} bytes."
            self._refuse(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "too_large", message)
        else:
            self.transport.abort()

    def _watch_reading(self) -> None:
        self._left, self._resumed = self._count_unread(), False
        self._unread = self.loop.call_later(self.patience.answer_s, self._check_reading)

    def _check_reading(self) -> None:
        """Close the connection if the client has read nothing since the last check; else check again later."""
        self._unread = None
        if not self.transport.get_write_buffer_size():
            return
        if self._count_unread() >= self._left and not self._resumed:
            self.transport.abort()
        else:
            self._watch_reading()

    def _count_unread(self) -> int:
        """Return the number of unsent bytes. It includes the kernel's buffer, which can hide a slow reader for long."""
        waiting = self.transport.get_write_buffer_size()
        with suppress(OSError, ValueError):  # a kernel without this call, a closed socket
            number = self.transport.get_extra_info("socket").fileno()
            waiting += int.from_bytes(fcntl.ioctl(number, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
        return waiting

    def _refuse(self, status: HTTPStatus, code: str, message: str) -> None:
        """Answer bytes that are not a valid request with an error, and close the connection."""
        body = ErrorResponse(error=ErrorBody(code=code, message=message)).model_dump()
        content = json.dumps(body).encode()
        head = b"content-type: application/json\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(content)
        self.transport.write(STATUS_LINE[status] + head + content)
        self.transport.close()


class _Refusing:
    """The application of a connection beyond the limit: answers health as usual and anything else with 429."""

    def __init__(self, app: ASGIApp, why: str) -> None:
        self.app, self.why = app, why

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"].startswith(HEALTH):
            await self.app(scope, receive, send)
            return
        headers = {"Retry-After": "1", "Connection": "close"}
        await refuse(BusyError(f"{self.why} Try again later.", headers=headers), scope, receive, send)


Guarded = TypeVar("Guarded", bound=GuardedProtocol)


def guarded(
    settings: Settings,
    patience: ClientPatience = PATIENCE,
    kind: type[Guarded] = GuardedProtocol,  # type: ignore[assignment]
    others: OtherConnections | None = None,
    **fields: Any,
) -> type[Guarded]:
    """Return a connection class with the limits of the settings, for `uvicorn.Config(http=...)`.

    kind: its base class; others: see `ConnectionLimit`; fields: further class variables.
    """
    limit = ConnectionLimit(settings, others)
    return type(kind.__name__, (kind,), {"patience": patience, "limit": limit, **fields})
