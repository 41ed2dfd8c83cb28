"""The application of the data plane: it answers queries of control loops and hands over all other requests."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.access.keys import Keyring
from service.api.access.middleware import KeyAccess, LocalAccess
from service.api.access.scopes import PREDICT, Rule
from service.api.errors import refuse
from service.api.limits.rates import RateLimit
from service.api.limits.requests import MAX_REQUESTS, Gate
from service.api.requests import HANDED_OVER, MAX_REFUSALS_PER_S, RequestContext, RequestLog
from service.api.route import JSON, OCTETS, Reply, is_json, media_type
from service.api.server.connections import CONNECTION
from service.api.shared import Shared
from service.api.stream.routes import EchoRoute, StreamRoute, Streams
from service.foundation.errors import BusyError, ServiceError
from service.foundation.settings import Settings
from service.inference import predicting
from service.inference.predicting import encode, one_motion, queries
from service.models.served import wait_for_revision
from service.planes.handover import PROTOCOL, RAW, pass_on, refuse_connection
from service.planes.link import ControlLink
from service.telemetry.meters import Meters

_PREDICT = re.compile(r"/v1/models/([^/]+)/predict")
_STREAM = re.compile(r"/v1/models/([^/]+)/stream")


class DataApp:
    """The application of the data plane. What it cannot answer it hands over."""

    def __init__(self, control: ControlLink, meters: Meters, shared: Shared) -> None:
        self.state = SimpleNamespace(loaded=control.loaded, learners=control, meters=meters, rules=self)
        self._control = control
        self.exception_handlers: dict[type, Any] = {}
        streams = Streams(shared.counters.gauge("admitted streams"))
        self._stream, self._echo = StreamRoute(streams), EchoRoute(streams)

    def of(self, method: str, path: str) -> Rule:
        """Return the rule of a request: stands in for `Rules`."""
        return Rule(None if path == "/health/live" else PREDICT, lasting=method == "WEBSOCKET")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request or hand it over."""
        path: str = scope["path"]
        if scope["type"] == "websocket":
            match = _STREAM.fullmatch(path)
            scope["path_params"] = {} if match is None else {"model": match[1]}
            route = scope["endpoint"] = self._echo if match is None else self._stream
            try:
                await route(scope, receive, send)
            except BusyError as error:
                await refuse(error, scope, receive, send)
            except ServiceError:
                self._hand_over_stream(scope)
            return
        if path == "/health/live":  # answered here, so that a hanging control plane does not restart a pod
            scope["path_params"], scope["route"] = {}, SimpleNamespace(path=path)
            alive = Reply(b'{"status":"alive"}')
            await send({"type": "http.response.start", "status": 200, "headers": alive.headers()})
            await send({"type": "http.response.body", "body": alive.body})
            return
        match = _PREDICT.fullmatch(path)
        scope["path_params"] = {} if match is None else {"model": match[1]}
        scope["route"] = SimpleNamespace(path="/v1/echo" if match is None else "/v1/models/{model}/predict")
        body = (await receive())["body"]
        try:
            reply = self._echoed(scope, body) if match is None else await self._predicted(scope, body, match[1])
        except ServiceError:
            reply = None
        if reply is None:
            scope[HANDED_OVER] = True
            scope[PROTOCOL].hand_over()
            return
        await send({"type": "http.response.start", "status": 200, "headers": reply.headers()})
        await send({"type": "http.response.body", "body": reply.body})

    def _hand_over_stream(self, scope: Scope) -> None:
        """Let the control plane explain why there is no stream."""
        connection = scope["state"][CONNECTION]
        scope[HANDED_OVER] = connection.handshake_complete = True  # uvicorn shall not answer
        if not pass_on(connection.transport, scope["state"][RAW], self._control.pass_on):
            refuse_connection(connection.transport)

    @staticmethod
    def _echoed(scope: Scope, body: bytes) -> Reply | None:
        if not media_type(scope):
            return None
        return Reply(body, JSON if is_json(scope) else OCTETS)

    async def _predicted(self, scope: Scope, body: bytes, model: str) -> Reply | None:
        query = queries.decode(body) if is_json(scope) and not scope["query_string"] else None
        motion = None if query is None else one_motion(query)
        if query is None or motion is None:
            return None
        loaded: Any = self.state.loaded
        served = loaded.hot(model, query.version, query.alias)
        if query.min_revision is not None:
            served = await wait_for_revision(loaded, model, query.version, query.alias, query.min_revision)
        if served is None:
            return None
        answer = predicting.predict_now(served, motion, loaded.settings.max_position, query.payload)
        return None if answer is None else Reply(encode(answer))


def with_middleware(
    app: DataApp, settings: Settings, keyring: Keyring | None, meters: Meters, shared: Shared
) -> ASGIApp:
    """Return the application below the middleware that queries pass in the control plane too."""
    wrapped: ASGIApp = app
    if settings.max_requests_per_s is not None:
        wrapped = RateLimit(wrapped, settings.max_requests_per_s, settings.max_request_burst, shared.buckets)
    wrapped = LocalAccess(wrapped) if keyring is None else KeyAccess(wrapped, keyring)
    wrapped = Gate(wrapped, MAX_REQUESTS, shared.counters.gauge("admitted requests"))
    log = RequestLog(["/v1/echo", "/v1/models/{model}/predict"], settings.log_slow_s, MAX_REFUSALS_PER_S)
    wrapped = RequestContext(wrapped, meters, log)

    async def outermost(scope: Scope, receive: Receive, send: Send) -> None:
        scope["app"] = app
        await wrapped(scope, receive, send)

    return outermost
