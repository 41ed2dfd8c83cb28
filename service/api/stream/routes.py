"""WebSocket routes: streams of torque queries, and an echo to measure latency without computation."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import NamedTuple
from urllib.parse import parse_qsl

from fastapi import APIRouter
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.utils import ClientDisconnected

from service.api.access.scopes import ADMIN, PREDICT, Rule
from service.api.server.streams import CONNECTION, StreamProtocol
from service.api.stream.conversation import Conversation, Echo
from service.api.stream.learning import StreamLearners
from service.api.stream.session import Session
from service.contract.models import ALIAS
from service.contract.predictions import one_choice
from service.foundation.errors import NotFoundError, NotReadyError, invalid_request, readable
from service.models.served import wait_for_revision
from service.runtime.counted import OpenCounter
from service.telemetry.counters import Gauge

STREAM_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
NUMBER = "[0-9]{1,10}"
PARAMETERS = {
    "version": (NUMBER, "the number of a version"),
    "alias": (ALIAS, f"a name that matches {ALIAS}"),
    "std": ("[01]", "0 or 1"),
    "scale": ("[01]", "0 or 1"),
    "payload": ("[01]", "0 or 1"),
    "rich": ("[01]", "0 or 1"),
    "without_gravity": ("[01]", "0 or 1"),
    "stream_id": (STREAM_ID, f"a name that matches {STREAM_ID}"),
    "min_revision": (NUMBER, "a revision of the version"),
}
"""Query parameters of a stream: pattern, and its description for errors."""
MIN_VALUES = {"version": 1, "min_revision": 0}
PATH, ECHO_PATH = "/v1/models/{model}/stream", "/v1/echo/stream"


def router(admitted: Gauge) -> APIRouter:
    """Return the routes, which count their connections together in `admitted`."""
    streams = Streams(admitted)
    router = APIRouter()
    # objects, not functions: those Starlette would wrap in its own WebSocket
    router.add_websocket_route(PATH, StreamRoute(streams), name="stream")  # type: ignore[arg-type]
    router.add_websocket_route(ECHO_PATH, EchoRoute(streams), name="echo")  # type: ignore[arg-type]
    router.add_websocket_route("/{path:path}", NoRoute(), name="no stream")  # type: ignore[arg-type]
    return router


class Streams(OpenCounter):
    """Counter of open streams."""

    too_many = "Too many streams: {} are open. Close one, or try again later."


class EchoRoute:
    """ASGI application of the echo; `path` is its name in metrics and logs."""

    path = ECHO_PATH
    rule = Rule(PREDICT, lasting=True)

    def __init__(self, streams: Streams) -> None:
        self.streams = streams

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one client. An error raised before the connection is accepted is answered in HTTP."""
        learners: StreamLearners = scope["app"].state.learners
        with self.streams.count_one(learners.settings.max_streams):
            conversation = await self.conversation(learners, scope, receive, send)
            with suppress(ClientDisconnected):  # the client disconnected during an answer, or its key became invalid
                await conversation.run()

    async def conversation(self, learners: StreamLearners, scope: Scope, receive: Receive, send: Send) -> Conversation:
        """Return the conversation with the client; raise ServiceError for a wrong address."""
        return Echo(_connection(scope), receive, send, learners.settings)


class StreamRoute(EchoRoute):
    """ASGI application of torque streams."""

    path = PATH

    async def conversation(self, learners: StreamLearners, scope: Scope, receive: Receive, send: Send) -> Conversation:
        """Return the conversation with the client.

        Raise InvalidRequestError, NotFoundError, UnreadableVersionError or RevisionNotReachedError.
        """
        asked = _parameters(scope["query_string"])
        model, version, alias = scope["path_params"]["model"], asked.version, asked.alias
        # with `min_revision` 0 this only loads the model
        served = await wait_for_revision(learners.loaded, model, version, alias, asked.min_revision)
        pinned = version is not None
        meter = scope["app"].state.meters.stream(served.name)
        given = (served, meter, pinned, asked.std, asked.stream_id, alias, asked.scale, asked.payload, asked.rich)
        connection = _connection(scope)
        return Session(connection, receive, send, learners, *given, without_gravity=asked.without_gravity)


class NoRoute:
    """ASGI application of all other addresses, which answers with an error. It must be the last route."""

    rule = Rule(ADMIN)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Raise NotFoundError."""
        raise NotFoundError(f"There is no stream at {scope['path'][:200]}. Streams are at {PATH}.")


class StreamParameters(NamedTuple):
    """Query parameters of a stream. `min_revision` is the min revision of its first answer."""

    version: int | None
    alias: str | None
    std: bool
    stream_id: str | None
    min_revision: int
    scale: bool
    payload: bool
    rich: bool
    without_gravity: bool


def _parameters(query: bytes) -> StreamParameters:
    """Parse the query of an address; raise InvalidRequestError."""
    given: dict[str, str] = {}
    for name, value in parse_qsl(query.decode("ascii", "backslashreplace"), keep_blank_values=True):
        if name not in PARAMETERS:
            known = ", ".join(PARAMETERS)
            message = f"Unknown stream parameter `{readable(name[:200])}`. Parameters: {known}."
            raise invalid_request(name, value, f"one of the parameters {known}", message)
        pattern, expected = PARAMETERS[name]
        if not re.fullmatch(pattern, value) or (name in MIN_VALUES and not MIN_VALUES[name] <= int(value) < 2**31):
            raise invalid_request(name, value, expected)
        given[name] = value
    version = int(given["version"]) if "version" in given else None
    one_choice(version, given.get("alias"))
    std, revision = given.get("std") == "1", int(given.get("min_revision", 0))
    flags = (given.get(name) == "1" for name in ("scale", "payload", "rich", "without_gravity"))
    return StreamParameters(version, given.get("alias"), std, given.get("stream_id"), revision, *flags)


def _connection(scope: Scope) -> StreamProtocol:
    connection = scope.get("state", {}).get(CONNECTION)
    if not isinstance(connection, StreamProtocol):
        raise NotReadyError("Streams only work on a server that was started with `lipserve serve`.")
    return connection
