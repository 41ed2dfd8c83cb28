"""The outermost middleware: request ids, metrics and request log; and the settings of OpenTelemetry."""

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
"""gRPC routes of control loops."""
READING = frozenset({"GET", "HEAD"})
"""Methods of requests that only read."""


def telemetry(settings: Settings) -> TelemetryConfig:
    """Return FastAPI's telemetry settings; raise MissingExtraError.

    Only traces are exported. Metrics are at /metrics, and errors are in the log with the id of the request.
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
"""Max log lines per second for refused requests of one route, status and code. Further ones are only counted."""


class RequestLog:
    """The request log: one line per request, with two exceptions.

    - Requests that only read (GET), of control loops (`quiet`) and of monitoring are logged only if they fail or take
      `slow_s` or longer: pages and clients poll, and a log line takes longer than the answer to a control loop.
    - Of equal refusals, `max_refusals` a second are logged and the others counted, so that a control loop with wrong
      requests does not fill the disk.
    """

    def __init__(self, quiet: Iterable[str], slow_s: float, max_refusals: int) -> None:
        self.quiet, self.slow_s, self.max_refusals = frozenset(quiet) | QUIET | MONITORING, slow_s, max_refusals
        self._refusals: dict[tuple[str, int, str], tuple[int, int]] = {}  # the current second and the number in it

    def may_log(self, method: str, route: str, seconds: float) -> bool:
        """Return whether a successful request may be logged: a quick check before `log_end`."""
        return not self._is_quiet(method, route) or seconds >= self.slow_s or request_lines.isEnabledFor(logging.DEBUG)

    def _is_quiet(self, method: str, route: str) -> bool:
        return method in READING or route in self.quiet

    def log_end(self, scope: Scope, kind: Kind, seconds: float) -> None:
        """Log an answered request or the end of a stream."""
        slow, missed = seconds >= self.slow_s and kind.status != 101, 0
        if kind.status >= 400:
            level, missed = logging.INFO if kind.status < 500 else logging.WARNING, self._count_skipped(kind)
        else:
            level = logging.DEBUG if self._is_quiet(kind.method, kind.route) and not slow else logging.INFO
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
        request_lines.log(level, what, extra={"fields": _request_fields(scope, kind.route) | fields})

    def log_open(self, scope: Scope, route: str) -> None:
        """Log the start of a stream."""
        if request_lines.isEnabledFor(logging.INFO):
            request_lines.info("stream opened", extra={"fields": _request_fields(scope, route)})

    def _count_skipped(self, kind: Kind) -> int:
        """Return how many equal refusals were skipped before this one; -1 if this one is skipped too."""
        now, sort = int(monotonic()), (kind.route, kind.status, kind.code)
        second, count = self._refusals.get(sort, (now, 0))
        missed, count = (0, count) if second == now else (max(count - self.max_refusals, 0), 0)
        self._refusals[sort] = now, count + 1
        return missed if count < self.max_refusals else -1


def _request_fields(scope: Scope, route: str) -> dict[str, Any]:
    """Return the log fields of a request. Path and method are cut, as clients choose them."""
    fields = {"route": route, "path": scope["path"][:200]}
    if "method" in scope:
        fields["method"] = scope["method"][:16]
    if scope.get("client"):
        fields["client"] = scope["client"][0]
    if KEY_ID in scope:
        fields["key"] = scope[KEY_ID]
    return fields


HANDED_OVER = "lipserve.handed_over"
"""Marks the scope of a request that another process answers."""
WEBSOCKET = "WEBSOCKET"
"""Stands in for the method of a WebSocket request."""


class RequestContext:
    """Middleware that gives a request an id, returns it in `X-Request-ID`, and measures the time until the answer.

    Unexpected exceptions are answered here, so that these answers have an id and are counted too. The exception is then
    raised again for the server and for tests.
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

        # a plain function: a coroutine would take time for every frame of a stream
        def note_status(message: Message) -> Awaitable[None]:
            nonlocal status, answered
            if not status and (begun := _status_of(message)):
                status, answered = begun, perf_counter()
                message["headers"] = [*message.get("headers", ()), (REQUEST_ID, name.encode())]
                if begun == 101:
                    self.requests.streams.add(1)
                    self.log.log_open(scope, _template(scope))
            return send(message)

        self.requests.in_flight.add(method is not WEBSOCKET)
        try:
            await self.app(scope, receive, note_status)
        except Exception as error:
            await self._answer(scope, receive, note_status, error, begun=bool(status))
            raise
        finally:
            self.requests.in_flight.add(-(method is not WEBSOCKET))
            self.requests.streams.add(-(status == 101))
            now = perf_counter()
            if HANDED_OVER not in scope:
                self._count(scope, method, status or 499, began, answered if status else now, now)

    def _count(self, scope: Scope, method: str, status: int, began: float, answered: float, now: float) -> None:
        """Count and log a request; status 499: the client disconnected."""
        path, seconds = _template(scope), now - began
        model: str = scope["path_params"].get("model", "") if path else ""
        kind = (method, path, model, status, scope.get(ERROR_CODE, ""))
        durations = self.known.get(kind)
        if durations is None:
            durations = self.requests.find(Kind(*kind), _exists(scope, model, method, status))
        durations.add(answered - began)
        if status >= 400 or self.log.may_log(method, path, seconds):
            self.log.log_end(scope, Kind(*kind), seconds)

    async def _answer(self, scope: Scope, receive: Receive, send: Send, error: Exception, begun: bool) -> None:
        """Answer a request after an unexpected exception, unless its answer has begun."""
        if begun or scope["type"] != "http":
            logger.error("unexpected error at %s", scope["path"][:200], exc_info=error)
            return
        handler = scope["app"].exception_handlers[Exception]
        answer = await handler(Request(scope), error)
        await answer(scope, receive, send)


def _status_of(message: Message) -> int:
    """Return the status of the answer that a message starts, 0 for other messages."""
    kind: str = message["type"]
    if kind.endswith("http.response.start"):
        status: int = message["status"]
        return status
    return {"websocket.accept": 101, "websocket.close": 403}.get(kind, 0)


def _template(scope: Scope) -> str:
    """Return the path template of the request's route, empty if no route matched."""
    route = scope.get("route") or scope.get("endpoint")  # Starlette sets no route for a WebSocket
    path: str = getattr(route, "path", "")
    return path


def _exists(scope: Scope, model: str, method: str, status: int) -> bool:
    """Return whether the model of an answered request exists. Of a refused one, it must have been used since the start.

    A request that deletes, or a stream, may outlive its model.
    """
    if not model or (status < 400 and method not in ("DELETE", WEBSOCKET)):
        return True
    loaded = getattr(scope["app"].state, "loaded", None)
    return loaded is not None and loaded.newest(model) is not None
