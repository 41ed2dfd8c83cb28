"""The application of the data plane: it answers queries of control loops and hands over all other requests."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from starlette.datastructures import State
from starlette.routing import BaseRoute, compile_path
from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.access.keys import Keyring
from service.api.access.middleware import KeyAccess, LocalAccess
from service.api.access.scopes import Rules
from service.api.errors import refuse, unexpected_error
from service.api.limits.rates import RateLimit
from service.api.limits.requests import MAX_REQUESTS, Gate
from service.api.oip import routes as oip
from service.api.oip.statistics import Statistics
from service.api.requests import MAX_REFUSALS_PER_S, RequestContext, RequestLog
from service.api.route import Answerer
from service.api.routes import health, predictions
from service.api.server.streams import CONNECTION as STREAM
from service.api.shared import Shared
from service.api.stream import routes as stream
from service.foundation.errors import NotFoundError, NotReadyError, ServiceError
from service.foundation.settings import Settings
from service.planes.connections import CONNECTION, DataProtocol, DataStream
from service.planes.frames import RemoteLearners
from service.planes.tracing import traced
from service.telemetry.meters import Meters

logger = logging.getLogger(__name__)


class QueryRoute(NamedTuple):
    """A route of queries. path: as in the control plane, for metrics and logs."""

    path: str
    answer: Answerer


ROUTES = (
    QueryRoute("/v1/models/{model}/predict", predictions.answer_at_once),
    QueryRoute("/v1/echo", predictions.answer_echo),
    QueryRoute("/v2/models/{model}/infer", oip.answer_at_once),
    QueryRoute("/v2/models/{model}/versions/{version}/infer", oip.answer_at_once),
    QueryRoute("/health/live", health.answer_live),
)


Found = TypeVar("Found")


class Paths(Generic[Found]):
    """Finds what belongs to a path. given: by path, with parameters in braces."""

    def __init__(self, given: Mapping[str, Found]) -> None:
        self._patterns = [(compile_path(path)[0], each) for path, each in given.items()]

    def find(self, scope: Scope) -> Found | None:
        """Return what belongs to the path of a request, and set `path_params`."""
        for pattern, each in self._patterns:
            if match := pattern.match(scope["path"]):
                scope["path_params"] = match.groupdict()
                return each
        return None


class DataApp:
    """The application of the data plane. It hands over what it cannot answer, errors included.

    state: what routes and middleware read, as in the state of the control plane's application. further: routes whose
    requests have an application of their own.
    """

    exception_handlers: ClassVar[dict[type[Exception], Any]] = {Exception: unexpected_error}

    def __init__(
        self, learners: RemoteLearners, meters: Meters, shared: Shared, further: Sequence[BaseRoute] = ()
    ) -> None:
        admitted = shared.counters.gauge("admitted streams")
        declared = [predictions.hot, predictions.echo_hot, oip.hot, health.router, stream.router(admitted)]
        rules = Rules([*(route for each in declared for route in each.routes), *further])
        self.state = State({"loaded": learners.loaded, "learners": learners, "meters": meters, "rules": rules})
        self.state.sequences, self.state.statistics = shared.sequences, Statistics(shared.counters)
        counter = stream.Streams(admitted)
        self._queries = Paths({route.path: route for route in ROUTES})
        self._streams = Paths({stream.PATH: stream.StreamRoute(counter), stream.ECHO_PATH: stream.EchoRoute(counter)})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or hand it over."""
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
        elif not await self._answer(scope, receive, send):
            connection: DataProtocol = scope[CONNECTION]
            connection.hand_over()

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> bool:
        """Answer a query; return whether it was one."""
        route = self._queries.find(scope)
        if route is None:
            return False
        scope["route"] = route
        body = (await receive()).get("body", b"")  # whole: see `find_query`
        try:
            reply = None if scope["query_string"] else await route.answer(scope, body)
        except ServiceError:
            return False
        except Exception as error:
            logger.error("the data plane hands over a query of %s", route.path, exc_info=error)
            return False
        if reply is None:
            return False
        await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
        await send({"type": "http.response.body", "body": reply.body})
        return True

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a stream; let the control plane explain that there is no such model."""
        connection: DataStream = scope["state"][STREAM]
        route = self._streams.find(scope)
        if route is None:
            connection.hand_over()
            return
        scope["endpoint"] = route
        try:
            await route(scope, receive, send)
        except (NotFoundError, NotReadyError):
            connection.hand_over()
        except ServiceError as error:
            await refuse(error, scope, receive, send)


def with_middleware(
    app: DataApp,
    settings: Settings,
    keyring: Keyring | None,
    meters: Meters,
    shared: Shared,
    inner: ASGIApp | None = None,
) -> ASGIApp:
    """Return the application below the middleware that queries pass in the control plane too.

    inner: answers requests instead of the application, of which only the state is read.
    """
    wrapped: ASGIApp = app if inner is None else inner
    if settings.max_requests_per_s is not None:
        wrapped = RateLimit(wrapped, settings.max_requests_per_s, settings.max_request_burst, shared.buckets)
    wrapped = LocalAccess(wrapped) if keyring is None else KeyAccess(wrapped, keyring)
    wrapped = Gate(wrapped, MAX_REQUESTS, shared.counters.gauge("admitted requests"))
    log = RequestLog([route.path for route in ROUTES], settings.log_slow_s, MAX_REFUSALS_PER_S)
    wrapped = RequestContext(wrapped, meters, log, settings.opentelemetry)

    async def outermost(scope: Scope, receive: Receive, send: Send) -> None:
        scope["app"] = app  # middleware reads its state
        await wrapped(scope, receive, send)

    return traced(outermost, settings)
