"""WebSocket routes: streams of torque queries, and an echo as the floor of their latency."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple
from urllib.parse import parse_qsl

from fastapi import APIRouter
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.utils import ClientDisconnected

from service.foundation.errors import BusyError, NotFoundError, NotReadyError, invalid_request
from service.inference.schema import one_choice
from service.learning.learners import Learners
from service.models.schema import ALIAS
from service.models.served import reached
from service.stream.conversation import Conversation, Echo
from service.stream.session import Session
from service.web.server.connections import CONNECTION, StreamProtocol

STREAM_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
PATH, ECHO_PATH = "/v1/models/{model}/stream", "/v1/echo/stream"


def router() -> APIRouter:
    """Return the routes, which count their connections together."""
    streams = Streams()
    router = APIRouter()
    # objects, not functions: those Starlette would wrap in its own WebSocket
    router.add_websocket_route(PATH, StreamRoute(streams), name="stream")  # type: ignore[arg-type]
    router.add_websocket_route(ECHO_PATH, EchoRoute(streams), name="echo")  # type: ignore[arg-type]
    router.add_websocket_route("/{path:path}", NoRoute(), name="no stream")  # type: ignore[arg-type]
    return router


class Streams:
    """How many connections are open."""

    def __init__(self) -> None:
        self.open = 0

    @contextmanager
    def one_more(self, most: int) -> Iterator[None]:
        """Count a connection while it lasts; raise BusyError beyond `most`."""
        if self.open >= most:
            raise BusyError(f"{self.open} streams are open, the most there may be: close one, or try again later")
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1


class EchoRoute:
    """ASGI application of the echo. path: its address, by which metrics and logs name it."""

    path = ECHO_PATH

    def __init__(self, streams: Streams) -> None:
        self.streams = streams

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Talk with one client. What is raised before it is accepted is answered in HTTP."""
        learners: Learners = scope["app"].state.learners
        with self.streams.one_more(learners.settings.max_streams):
            conversation = await self.conversation(learners, scope, receive, send)
            with suppress(ClientDisconnected):  # no error: it went away while it was answered, or its key ended
                await conversation.run()

    async def conversation(self, learners: Learners, scope: Scope, receive: Receive, send: Send) -> Conversation:
        """Return what talks with the client; raise ServiceError where the address is wrong."""
        return Echo(_connection(scope), receive, send, learners.settings)


class StreamRoute(EchoRoute):
    """ASGI application of torque streams."""

    path = PATH

    async def conversation(self, learners: Learners, scope: Scope, receive: Receive, send: Send) -> Conversation:
        """Return what talks with the client; raise InvalidRequestError, NotFoundError, UnreadableVersionError or
        RevisionNotReachedError."""
        asked = _parameters(scope["query_string"])
        model, version, alias = scope["path_params"]["model"], asked.version, asked.alias
        # with 0 it waits for nothing but the model to be in memory
        served = await reached(learners.loaded, model, version, alias, asked.min_revision)
        pinned = version is not None
        meter = scope["app"].state.meters.stream(served.name)
        given = (served, meter, pinned, asked.std, asked.stream_id, alias)
        return Session(_connection(scope), receive, send, learners, *given)


class NoRoute:
    """ASGI application of all other addresses, which Starlette would refuse without a word. To be the last."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse to talk: raise NotFoundError."""
        raise NotFoundError(f"no stream at {scope['path'][:200]}: streams are at {PATH}")


class Asked(NamedTuple):
    """What the address of a stream says. min_revision: that its first answer has at least."""

    version: int | None
    alias: str | None
    std: bool
    stream_id: str | None
    min_revision: int


def _parameters(query: bytes) -> Asked:
    """Read the query of an address; raise InvalidRequestError."""
    version, alias, std, stream_id, min_revision = None, None, False, None, 0
    for name, value in parse_qsl(query.decode("ascii", "backslashreplace"), keep_blank_values=True):
        if name == "version":
            if not re.fullmatch("[0-9]{1,10}", value) or not 0 < int(value) < 2**31:
                raise invalid_request("version", value, "the number of a version")
            version = int(value)
        elif name == "alias":
            if not re.fullmatch(ALIAS, value):
                raise invalid_request("alias", value, f"a name that matches {ALIAS}")
            alias = value
        elif name == "std":
            if value not in ("0", "1"):
                raise invalid_request("std", value, "0 or 1")
            std = value == "1"
        elif name == "stream_id":
            if not re.fullmatch(STREAM_ID, value):
                raise invalid_request("stream_id", value, f"a name that matches {STREAM_ID}")
            stream_id = value
        elif name == "min_revision":
            if not re.fullmatch("[0-9]{1,10}", value) or not int(value) < 2**31:
                raise invalid_request("min_revision", value, "a revision of the version")
            min_revision = int(value)
        else:
            raise invalid_request(name, value, "no parameter but version, alias, std, stream_id and min_revision")
    one_choice(version, alias)
    return Asked(version, alias, std, stream_id, min_revision)


def _connection(scope: Scope) -> StreamProtocol:
    connection = scope.get("state", {}).get(CONNECTION)
    if not isinstance(connection, StreamProtocol):
        raise NotReadyError("streams need the server that `lipserve serve` starts")
    return connection
