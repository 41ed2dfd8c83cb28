"""The connections of both planes, for uvicorn."""

from __future__ import annotations

import asyncio
import re
from dataclasses import replace
from typing import Any, ClassVar

from service.api.limits.requests import COUNTED, HEALTH
from service.api.requests import HANDED_OVER
from service.api.server.connection_limit import Excess
from service.api.server.connections import GuardedProtocol
from service.api.server.streams import StreamProtocol
from service.planes.counting import PassedConnections
from service.planes.handover import OTHER, PART, Handed, PassOn, find_query, refuse_connection, shared

CONNECTION = "lipserve.http_connection"
"""Key of the connection in the ASGI scope of a request that the data plane may hand over."""
_REQUEST = "lipserve.stream_request"
"""Key of the bytes of a stream's request, and its client as in `LimitedConnection`, in the state of its connection."""
_HEALTH_REQUEST = re.compile(rb"[A-Z]+ " + HEALTH.encode())
"""The start of a request that is answered on connections beyond the limit, too."""


class DataProtocol(GuardedProtocol):
    """A connection in the data plane: it answers whole queries, and passes itself on at any other request.

    control: passes connections to the control plane. passed: counts them. handed: of a connection that came from there.
    """

    control: ClassVar[PassOn]
    passed: ClassVar[PassedConnections]

    def __init__(self, *args: Any, handed: Handed | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._handed = handed
        self._query = b""  # the request that is being answered
        self._part = b""  # the start of a query
        self._later = b""  # what came during an answer
        self._whole = False
        self._leaving: bool | None = None  # to the control plane; whether the request was counted
        self._deciding: asyncio.Task[None] | None = None  # whether this connection exceeds a limit

    def admit(self) -> Excess:
        """Make room for this connection, unless it was admitted before."""
        if self._handed is None:
            return super().admit()
        self.limit.adopt(self)
        return Excess(0)

    def exceed(self, excess: Excess) -> None:
        """Wait until the control plane has closed an idle connection, or refuse requests."""
        self._deciding = self.loop.create_task(self._decide(excess))

    async def _decide(self, excess: Excess) -> None:
        if not await self.passed.shed(excess.peer):
            self.refuse_requests(excess.why)
        self._deciding = None
        self._read_later()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, with the bytes that the control plane has read, if any."""
        super().connection_made(transport)
        if self._handed is not None:
            if self._handed.refused:
                self.refuse_requests(self._handed.refused)
            data, self._handed = self._handed.read, None  # frees memory
            self._read(data)

    def data_received(self, data: bytes) -> None:
        """Handle bytes from the socket; those that come during an answer wait."""
        if self._is_busy():
            self._later += data
            self.transport.pause_reading()
        else:
            self._read(self._part + data)

    def _is_busy(self) -> bool:
        """Return whether further bytes must wait."""
        answering = self.cycle is not None and not self.cycle.response_complete
        return answering or self._leaving is not None or self._deciding is not None

    def _read(self, data: bytes) -> None:
        """Answer a query, collect the rest of one, or pass the connection on."""
        size, self._part = find_query(data), b""
        if size == PART:
            self._part = data
            self._unset_keepalive_if_required()
            self._watch_head()
        elif size == OTHER and self.refused and not _HEALTH_REQUEST.match(data):
            super().data_received(data)
        elif size == OTHER:
            self._query = data
            self._pass_on(counted=False)
        else:
            self._query, self._later, self._whole = data[:size], data[size:], False
            if self._later:
                self.transport.pause_reading()
            super().data_received(self._query)
            if not (self._whole or self._upgraded or self.transport.is_closing()):
                self.hand_over(counted=False)  # the parser expects more than `find_query`

    def handle_websocket_upgrade(self) -> None:
        """Begin a stream, whose request may still be handed over."""
        self.app_state = {**self.app_state, _REQUEST: (self._query, self.peer)}
        self._forget_scope()
        super().handle_websocket_upgrade()

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        super().connection_lost(exc)
        self._forget_scope()

    def on_message_begin(self) -> None:
        """Give the application a way to hand the request over."""
        super().on_message_begin()
        scope: Any = self.scope
        scope[CONNECTION] = self

    def _forget_scope(self) -> None:
        """End the reference cycle between connection and request, see `StreamProtocol`."""
        if self.scope is not None:
            self.scope.pop(CONNECTION, None)  # type: ignore[misc]

    def on_message_complete(self) -> None:
        """Note that the parser has read the whole request."""
        self._whole = True
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Handle what came before the end of the answer."""
        super().on_response_complete()
        if self._later and not self.transport.is_closing():
            self._unset_keepalive_if_required()
            self.loop.call_soon(self._read_later)

    def _read_later(self) -> None:
        if self._later and not self.transport.is_closing():
            later, self._later = self._later, b""
            self.transport.resume_reading()
            self._read(later)

    def hand_over(self, counted: bool = True) -> None:
        """Let the control plane answer the present request and those that follow.

        counted: whether rate limits have counted it.
        """
        scope: Any = self.cycle.scope
        scope[HANDED_OVER] = self.cycle.disconnected = True
        self._pass_on(counted)

    def _pass_on(self, counted: bool) -> None:
        if self.transport.is_closing():
            return
        self._leaving = counted
        self.transport.pause_reading()
        if self.transport.get_write_buffer_size():
            self.transport.set_write_buffer_limits(0)  # `resume_writing` is called after the last byte
        else:
            self._leave()

    def resume_writing(self) -> None:
        """Resume writing, or leave after the last answer was sent."""
        super().resume_writing()
        if self._leaving is not None and not self.transport.is_closing():
            self._leave()

    def _leave(self) -> None:
        handed = Handed(shared(self._query + self._later), bool(self._leaving), self.refused)
        if not self.control(self.transport, handed, self.peer):
            refuse_connection(self.transport, self._query)

    def _late(self) -> None:
        """Close a connection without a request in time; the control plane waits for a slow body."""
        if b"\r\n\r\n" in self._part and not self.transport.is_closing():
            self._head, self._query, self._part = None, self._part, b""
            self._pass_on(counted=False)
            return
        self._overhead += len(self._part)
        self._part = b""
        super()._late()


class DataStream(StreamProtocol):
    """A stream in the data plane, whose request may be handed over before it is accepted."""

    control: ClassVar[PassOn]

    def hand_over(self) -> None:
        """Let the control plane explain why there is no stream."""
        scope: Any = self.scope
        scope[HANDED_OVER] = self.handshake_complete = True  # uvicorn shall not answer
        request, peer = self.app_state[_REQUEST]
        if self.transport.is_closing():
            return
        if not self.control(self.transport, Handed(shared(request), counted=True), peer):
            refuse_connection(self.transport, request)


class ControlProtocol(GuardedProtocol):
    """A connection in the control plane, which passes itself back at the next query.

    data: passes connections to the data plane. handed: what came with the connection.
    """

    data: ClassVar[PassOn]

    def __init__(self, *args: Any, handed: Handed, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._handed = handed
        self._first = True
        self._between = False  # two requests: the parser has read the last one to its end

    def admit(self) -> Excess:
        """Add this connection, which the data plane has admitted."""
        self.limit.adopt(self)
        return Excess(0)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin with the bytes that the data plane has read."""
        super().connection_made(transport)
        if self._handed.refused:
            self.refuse_requests(self._handed.refused)
        data, self._handed = self._handed.read, replace(self._handed, data=b"")  # frees memory
        super().data_received(data)

    def data_received(self, data: bytes) -> None:
        """Handle bytes from the socket; pass the connection back at the start of a query."""
        idle = self._between and self.cycle.response_complete and not self._upgraded
        if idle and not self.transport.get_write_buffer_size() and find_query(data) != OTHER:
            if self.data(self.transport, Handed(shared(data), refused=self.refused), self.peer):
                return
            self.transport.resume_reading()  # no data plane: it is answered here
        super().data_received(data)

    def on_message_begin(self) -> None:
        """Mark the first request as counted if the data plane has counted it."""
        super().on_message_begin()
        self._between = False
        if self._first and self._handed.counted:
            scope: Any = self.scope
            scope[COUNTED] = True
        self._first = False

    def on_message_complete(self) -> None:
        """Note the end of a request."""
        self._between = True
        super().on_message_complete()
