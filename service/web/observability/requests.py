"""The outermost middleware: every request gets an id, is counted, and logged where it is worth a line."""

from __future__ import annotations

import logging
from collections.abc import Awaitable
from time import perf_counter

from opentelemetry import trace  # FastAPI's own requirement
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.foundation.errors import ERROR_CODE
from service.web.observability.context import REQUEST_ID, given_request_id, new_request_id, request_id
from service.web.observability.meters import Kind, Meters
from service.web.observability.request_log import RequestLog

logger = logging.getLogger(__name__)

WEBSOCKET = "WEBSOCKET"
"""Stands for the method of a request for a stream."""
GONE = 499
"""Stands for the status of a request whose client went away before it was answered."""


class RequestContext:
    """Names a request, answers the name in `X-Request-ID`, and measures how long the answer took to begin.

    What the application did not expect is answered here, so that this answer too has its id and is counted; the
    exception goes on, as servers and tests want to see it.
    """

    def __init__(self, app: ASGIApp, meters: Meters, log: RequestLog, tracing: bool = False) -> None:
        self.app, self.log, self.requests, self.tracing = app, log, meters.requests, tracing
        self.known = meters.requests.known

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        name = given_request_id(scope["headers"]) or new_request_id()
        request_id.set(name)  # of this request's own task
        if self.tracing:
            trace.get_current_span().set_attribute("lipserve.request_id", name)
        method: str = scope.get("method", WEBSOCKET)
        status, began = 0, perf_counter()
        answered = began

        # no coroutine of its own, which would cost every frame of a stream
        def tell(message: Message) -> Awaitable[None]:
            nonlocal status, answered
            if not status and (found := _status(message)):
                status, answered = found, perf_counter()
                message["headers"] = [*message.get("headers", ()), (REQUEST_ID, name.encode())]
                if found == 101:
                    self.requests.streams += 1
                    self.log.opened(scope, _template(scope))
            return send(message)

        self.requests.in_flight += method is not WEBSOCKET
        try:
            await self.app(scope, receive, tell)
        except Exception as error:
            await self._answer(scope, receive, tell, error, begun=bool(status))
            raise
        finally:
            self.requests.in_flight -= method is not WEBSOCKET
            self.requests.streams -= status == 101
            now = perf_counter()
            if not status:
                status, answered = GONE, now
            path, seconds = _template(scope), now - began
            model: str = scope["path_params"].get("model", "") if path else ""
            kind = (method, path, model, status, scope.get(ERROR_CODE, ""))
            durations = self.known.get(kind)
            if durations is None:
                durations = self.requests.find(Kind(*kind), status < 400 or _exists(scope, model))
            durations.add(answered - began)
            if status >= 400 or self.log.worth(path, seconds):
                self.log.answered(scope, Kind(*kind), seconds)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, error: Exception, begun: bool) -> None:
        """Answer a request that failed unexpectedly, unless its answer has begun."""
        if begun or scope["type"] != "http":
            logger.error("unexpected error at %s", scope["path"][:200], exc_info=error)
            return
        handler = scope["app"].exception_handlers[Exception]
        answer = await handler(Request(scope), error)
        await answer(scope, receive, send)


def _status(message: Message) -> int:
    """Status of the answer that a message begins, 0 where it begins none."""
    kind: str = message["type"]
    if kind.endswith("http.response.start"):
        status: int = message["status"]
        return status
    return {"websocket.accept": 101, "websocket.close": 403}.get(kind, 0)


def _template(scope: Scope) -> str:
    """Path of the route that a request has reached, with the names of its parameters; empty where it reached none."""
    route = scope.get("route") or scope.get("endpoint")  # Starlette names no route of a WebSocket
    found: str = getattr(route, "path", "")
    return found


def _exists(scope: Scope, model: str) -> bool:
    """Whether the model of a refused request is known to exist: not where nobody has asked for it since the start."""
    loaded = getattr(scope["app"].state, "loaded", None)
    return loaded is not None and loaded.newest(model) is not None
