"""The application of the data plane: its requests are logged and traced as those of the control plane."""

from functools import partial
from types import SimpleNamespace

import pytest
from opentelemetry import trace
from starlette.testclient import TestClient

from service.api.requests import HANDED_OVER
from service.api.shared import Shared
from service.foundation.settings import Settings
from service.planes.answers import DataApp, with_middleware
from service.planes.connections import CONNECTION
from service.telemetry.meters import Meters
from tests.service.api.test_requests import spans
from tests.service.data import ADDRESS

__all__ = ["spans"]  # a fixture


@pytest.fixture
def client(api):
    """Return clients of applications of the data plane that answer with the models of another service."""

    def make(**settings):
        state, shared = api.app.state, Shared()
        learners, meters = SimpleNamespace(loaded=state.loaded), Meters(counters=shared.counters)
        app = DataApp(learners, meters, shared)
        made = with_middleware(app, Settings(**settings), None, meters, shared)

        async def on_a_connection(scope, receive, send):
            scope[CONNECTION] = SimpleNamespace(hand_over=partial(scope.update, {HANDED_OVER: True}))
            await made(scope, receive, send)
            if HANDED_OVER in scope:
                await send({"type": "http.response.start", "status": 204})
                await send({"type": "http.response.body"})

        return TestClient(on_a_connection, ADDRESS)

    return make


def test_query_is_a_span_with_route_and_id(client, spans):
    parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    headers = {"x-request-id": "mine", "traceparent": parent}
    assert client(opentelemetry=True).post("/v1/echo", json={}, headers=headers).json() == {}
    (span,) = (span for span in spans() if span.kind is trace.SpanKind.SERVER)
    assert span.name == "POST /v1/echo"
    assert span.attributes["lipserve.request_id"] == "mine"
    assert f"{span.context.trace_id:032x}" in parent


def test_queries_without_tracing_have_no_spans(client, spans):
    assert client().post("/v1/echo", json={}).json() == {}
    assert client(opentelemetry=True).get("/health/live").is_success
    assert spans() == ()


def test_request_that_is_handed_over_has_no_span_and_is_not_counted(client, spans):
    made = client(opentelemetry=True)
    assert made.post("/v1/models/panda-sim/predict", json={}).status_code == 204
    assert spans() == ()


def test_refused_query_is_a_span_with_its_status(client, spans):
    assert client(opentelemetry=True).post("/v1/echo", headers={"host": "other.example"}).status_code == 403
    (span,) = spans()
    assert span.attributes["http.response.status_code"] == 403
    assert span.status.is_ok
