"""Traces: off unless they are asked for, one span a request with its route and id where they are."""

from __future__ import annotations

import logging

import pytest
from fastapi.testclient import TestClient
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from service.app import create_app
from service.foundation.settings import Settings
from service.web.observability import logs, requests
from tests.service.data import ADDRESS


@pytest.fixture
def spans(monkeypatch):
    """What ends up in a tracer that the process has."""
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    monkeypatch.setattr(requests, "_installed", lambda: True)
    return exporter.get_finished_spans


def client(home, **settings):
    # never started: the echo needs no service
    return TestClient(create_app(Settings(home=home, **settings)), ADDRESS)


def test_a_request_is_a_span_with_its_route_and_id(spans, home):
    parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    headers = {"x-request-id": "mine", "traceparent": parent}
    assert client(home, opentelemetry=True).post("/v1/echo", json={}, headers=headers).status_code == 200
    (span,) = (span for span in spans() if span.kind is trace.SpanKind.SERVER)
    assert span.name == "POST /v1/echo"
    assert span.attributes["lipserve.request_id"] == "mine"
    assert f"{span.context.trace_id:032x}" in parent


def test_monitoring_is_not_traced(spans, home):
    assert client(home, opentelemetry=True).get("/health/live").status_code == 200
    assert spans() == ()


def test_nothing_is_traced_unless_it_is_asked_for(spans, home):
    assert client(home).post("/v1/echo", json={}).status_code == 200
    assert spans() == ()


def test_without_the_package_the_start_says_what_to_install(monkeypatch, home):
    monkeypatch.setattr(requests, "EXPORTER", "opentelemetry.exporter.nowhere")
    with pytest.raises(ValueError, match=r"pip install 'lipserve\[opentelemetry\]'"):
        client(home, opentelemetry=True)


def test_a_line_within_a_trace_names_it():
    record = logging.getLogger("x").makeRecord("x", logging.INFO, __file__, 1, "said", (), None)
    with TracerProvider().get_tracer("t").start_as_current_span("s") as span:
        line = logs._formatter("json").format(record)
    assert f'"trace_id": "{span.get_span_context().trace_id:032x}"' in line
