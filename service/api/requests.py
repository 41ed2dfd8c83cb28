"""The outermost middleware: every request gets an id, is counted, and logged where that tells something; and what is
reported to OpenTelemetry."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Iterable
from time import monotonic, perf_counter
from typing import Any

from fastapi.telemetry import TelemetryConfig
from opentelemetry import trace  # FastAPI's own requirement
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from lipcore import extras
from service.api.errors import ERROR_CODE
from service.foundation.settings import Settings
from service.telemetry.logs import KEY_ID, REQUEST_ID, new_request_id, read_request_id, request_id, request_scope
from service.telemetry.meters import Kind, Meters

_OF_CALLS = "/inference.GRPCInferenceService/"
MONITORING = frozenset(
    {
        *("/health", "/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready", "/metrics"),
        *(f"{_OF_CALLS}ServerLive", f"{_OF_CALLS}ServerReady"),
    }
)
QUIET = frozenset({f"{_OF_CALLS}ModelInfer"})
"""Routes of control loops that no request over HTTP reaches."""


def telemetry(settings: Settings) -> TelemetryConfig:
    """What FastAPI shall report; raise MissingExtraError.

    Metrics are at /metrics, and what went wrong is in the log, with the id of the request: neither goes this way.
    """
    on = settings.opentelemetry
    if on:
        extras.check_extra("opentelemetry", "LIPSERVE_OPENTELEMETRY is set")
    return {
        "tracing": on,
        "metrics": False,
        "logs": False,
        "operation_spans": on,
        "auto_configure": on,
        "exclude": lambda scope: scope["path"] in MONITORING,
    }


request_lines = logging.getLogger("service.requests")
logger = logging.getLogger(__name__)

MAX_REFUSALS_PER_S = 10
"""Refused requests of one route and code that are logged in a second; the others are counted."""


class RequestLog:
    """One line for each request, with three exceptions.

    Queries and batches of a control loop, and what monitoring asks for, are logged from `slow_s` on or where they fail:
    a line takes longer than an answer. Of equal refusals, `most_refusals` a second are logged and the others counted:
    a loop that asks wrong, or without a key, must not fill the disk. quiet: routes of control loops.
    """

    def __init__(self, quiet: Iterable[str], slow_s: float, most_refusals: int) -> None:
        self.quiet, self.slow_s, self.most_refusals = frozenset(quiet) | QUIET | MONITORING, slow_s, most_refusals
        self._refusals: dict[tuple[str, int, str], tuple[int, int]] = {}  # the second, and how many there were in it

    def may_log(self, route: str, seconds: float) -> bool:
        """Whether a request that was not refused may be worth a line: a quick look, before more is made of it."""
        return route not in self.quiet or seconds >= self.slow_s or request_lines.isEnabledFor(logging.DEBUG)

    def answered(self, scope: Scope, kind: Kind, seconds: float) -> None:
        """Log a request that has been answered; of a stream, its end."""
        slow, missed = seconds >= self.slow_s and kind.status != 101, 0
        if kind.status >= 400:
            level, missed = logging.INFO if kind.status < 500 else logging.WARNING, self._missed(kind)
        else:
            level = logging.DEBUG if kind.route in self.quiet and not slow else logging.INFO
        if missed < 0 or not request_lines.isEnabledFor(level):
            return
        fields: dict[str, Any] = {"status": kind.status, "duration_ms": round(seconds * 1e3, 3)}
        if kind.code:
            fields["code"] = kind.code
        if slow:
            fields["slow"] = True
        if missed:
            fields["not_logged"] = missed
        what = "stream closed" if kind.status == 101 else "request"
        request_lines.log(level, what, extra={"fields": _of(scope, kind.route) | fields})

    def opened(self, scope: Scope, route: str) -> None:
        """Log a stream that begins."""
        if request_lines.isEnabledFor(logging.INFO):
            request_lines.info("stream opened", extra={"fields": _of(scope, route)})

    def _missed(self, kind: Kind) -> int:
        """How many equal refusals were not logged before this one; -1 where this one is not either."""
        now, sort = int(monotonic()), (kind.route, kind.status, kind.code)
        second, count = self._refusals.get(sort, (now, 0))
        missed, count = (0, count) if second == now else (max(count - self.most_refusals, 0), 0)
        self._refusals[sort] = now, count + 1
        return missed if count < self.most_refusals else -1


def _of(scope: Scope, route: str) -> dict[str, Any]:
    """What a line says of a request: its address without the query, cut, as clients choose both."""
    fields = {"route": route, "path": scope["path"][:200]}
    if "method" in scope:
        fields["method"] = scope["method"][:16]
    if scope.get("client"):
        fields["client"] = scope["client"][0]
    if KEY_ID in scope:
        fields["key"] = scope[KEY_ID]
    return fields


WEBSOCKET = "WEBSOCKET"
"""Stands for the method of a request for a stream."""


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
        name = read_request_id(scope["headers"]) or new_request_id()
        request_id.set(name)  # of this request's own task
        request_scope.set(scope)
        if self.tracing:
            trace.get_current_span().set_attribute("lipserve.request_id", name)
        method: str = scope.get("method", WEBSOCKET)
        status, began = 0, perf_counter()
        answered = began

        # no coroutine of its own, which would cost every frame of a stream
        def note_status(message: Message) -> Awaitable[None]:
            nonlocal status, answered
            if not status and (begun := _status_of(message)):
                status, answered = begun, perf_counter()
                message["headers"] = [*message.get("headers", ()), (REQUEST_ID, name.encode())]
                if begun == 101:
                    self.requests.streams += 1
                    self.log.opened(scope, _template(scope))
            return send(message)

        self.requests.in_flight += method is not WEBSOCKET
        try:
            await self.app(scope, receive, note_status)
        except Exception as error:
            await self._answer(scope, receive, note_status, error, begun=bool(status))
            raise
        finally:
            self.requests.in_flight -= method is not WEBSOCKET
            self.requests.streams -= status == 101
            now = perf_counter()
            if not status:
                status, answered = 499, now  # the client went away
            path, seconds = _template(scope), now - began
            model: str = scope["path_params"].get("model", "") if path else ""
            kind = (method, path, model, status, scope.get(ERROR_CODE, ""))
            durations = self.known.get(kind)
            if durations is None:
                durations = self.requests.find(Kind(*kind), status < 400 or _exists(scope, model))
            durations.add(answered - began)
            if status >= 400 or self.log.may_log(path, seconds):
                self.log.answered(scope, Kind(*kind), seconds)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, error: Exception, begun: bool) -> None:
        """Answer a request that failed unexpectedly, unless its answer has begun."""
        if begun or scope["type"] != "http":
            logger.error("unexpected error at %s", scope["path"][:200], exc_info=error)
            return
        handler = scope["app"].exception_handlers[Exception]
        answer = await handler(Request(scope), error)
        await answer(scope, receive, send)


def _status_of(message: Message) -> int:
    """Status of the answer that a message begins, 0 where it begins none."""
    kind: str = message["type"]
    if kind.endswith("http.response.start"):
        status: int = message["status"]
        return status
    return {"websocket.accept": 101, "websocket.close": 403}.get(kind, 0)


def _template(scope: Scope) -> str:
    """Path of the route that a request has reached, with the names of its parameters; empty where it reached none."""
    route = scope.get("route") or scope.get("endpoint")  # Starlette names no route of a WebSocket
    path: str = getattr(route, "path", "")
    return path


def _exists(scope: Scope, model: str) -> bool:
    """Whether the model of a refused request is known to exist: not where nobody has asked for it since the start."""
    loaded = getattr(scope["app"].state, "loaded", None)
    return loaded is not None and loaded.newest(model) is not None
