"""Traces of requests that the data plane answers, as FastAPI makes them in the control plane."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from opentelemetry import propagate, trace
from opentelemetry.trace import SpanKind, StatusCode
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.requests import HANDED_OVER, MONITORING, telemetry
from service.foundation.settings import Settings


def traced(app: ASGIApp, settings: Settings) -> ASGIApp:
    """Return an application with a span of each request that it answers, if the settings ask for traces.

    At the start of its lifespan FastAPI prepares the export of spans.
    """
    return Tracing(app, FastAPI(telemetry=telemetry(settings), openapi_url=None)) if settings.opentelemetry else app


class Tracing:
    """Middleware that makes a span of each request. The span of a request that is handed over is dropped.

    exporting: prepares the export in its lifespan.
    """

    def __init__(self, app: ASGIApp, exporting: FastAPI) -> None:
        self._app, self._exporting = app, exporting

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] == "lifespan":
            await self._exporting(scope, receive, send)
            return
        if scope["path"] in MONITORING:
            await self._app(scope, receive, send)
            return
        headers: Any = Headers(scope=scope)
        method = scope.get("method", "WS")
        tracer = trace.get_tracer_provider().get_tracer(__name__)
        span = tracer.start_span(method, propagate.extract(headers), SpanKind.SERVER)
        span.set_attribute("url.path", scope["path"])
        if "method" in scope:
            span.set_attribute("http.request.method", method)

        async def note_status(message: Message) -> None:
            if message["type"] == "http.response.start":
                span.set_attribute("http.response.status_code", message["status"])
                if message["status"] >= 500:
                    span.set_status(StatusCode.ERROR)
            await send(message)

        try:
            with trace.use_span(span, record_exception=False):
                await self._app(scope, receive, note_status)
        finally:
            if HANDED_OVER not in scope:
                route = getattr(scope.get("route") or scope.get("endpoint"), "path", "")
                if route:
                    span.set_attribute("http.route", route)
                    span.update_name(f"{method} {route}")
                span.end()
