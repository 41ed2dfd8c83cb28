"""Every request has an id, a log line if it needs one, and a span if tracing is on."""

import asyncio
import logging
import re
import threading
from contextlib import closing
from unittest.mock import AsyncMock, Mock

import pytest
from fastapi.testclient import TestClient
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from lipcore.extras import EXTRAS, Extra, MissingExtraError
from service.api import requests
from service.api.requests import RequestContext, RequestLog
from service.app import create_app
from service.foundation.settings import Settings
from service.inference import predicting as inference
from service.learning.learners import IngestThreads
from service.telemetry import logs
from service.telemetry.logs import KEY_ID, new_request_id, read_request_id, request_id
from service.telemetry.meters import Kind, Meters
from tests.service.data import ADDRESS, error, stream, upload

MADE = re.compile(r"[0-9a-f]{12}-[0-9a-f]+")
QUERY = {"q": [0.0] * 7, "dq": [0.0] * 7, "ddq": [0.0] * 7}


def run_context(app, scope):
    """Return the messages that an application sends through the middleware."""
    send = AsyncMock()
    context = RequestContext(app, Meters(), RequestLog((), slow_s=1.0, max_refusals=1))
    asyncio.run(context({"headers": [], "path": "/x", "app": None, **scope}, AsyncMock(), send))
    return [call.args[0] for call in send.await_args_list]


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/v1/models", 200),
        ("GET", "/nowhere", 404),
        ("PATCH", "/v1/models", 405),
        ("POST", "/v1/models/panda-sim/predict", 200),
        ("POST", "/v1/models/nobody/predict", 404),
        ("GET", "/v2/models/nobody", 404),
    ],
)
def test_every_answer_has_its_own_id(api, method, path, status):
    answers = [api.request(method, path, json=QUERY if method == "POST" else None) for _ in range(2)]
    assert [each.status_code for each in answers] == [status, status]
    ids = {each.headers["x-request-id"] for each in answers}
    assert len(ids) == 2
    assert all(MADE.fullmatch(each) for each in ids)


@pytest.mark.parametrize("given", ["a", "robot-1.loop_2", "x" * 64])
def test_given_id_is_returned(api, given):
    assert api.get("/v1/models", headers={"x-request-id": given}).headers["x-request-id"] == given


@pytest.mark.parametrize(
    "given", [b"", b"a b", b"x" * 65, b'a"b', b"<a>", b"-._", b"caf\xe9", b"\xc2\xb2", b"a\r\nset-cookie: b"]
)
def test_harmful_id_is_replaced(given):
    made = new_request_id()
    assert read_request_id([(b"x-request-id", made.encode())]) == made
    assert read_request_id([(b"x-request-id", given), (b"x-request-id", b"two")]) is None  # the first one counts
    assert read_request_id([(b"x-request-id", b"one"), (b"x-request-id", given)]) == "one"


def test_unexpected_error_is_logged_with_its_id_and_raised(api, monkeypatch):
    seen = []

    class Ids(logging.Handler):
        def emit(self, record):
            seen.append((record.getMessage(), request_id.get()))

    def send_request(client):
        query = {**QUERY, "components": ["gravity"]}
        return client.post("/v1/models/panda-sim/predict", json=query, headers={"x-request-id": "mine"})

    monkeypatch.setattr(inference, "predict", Mock(side_effect=RuntimeError("secret")))
    monkeypatch.setattr(logging.getLogger("service.api.errors"), "handlers", [Ids()])
    answer = send_request(TestClient(api.app, ADDRESS, raise_server_exceptions=False))
    assert answer.headers["x-request-id"] == "mine"
    assert "secret" not in str(error(answer, 500, "internal_error"))
    assert seen == [("unexpected error at POST /v1/models/panda-sim/predict", "mine")]
    with pytest.raises(RuntimeError, match="secret"):  # the server that runs the tests must see the error
        send_request(api)


def test_failure_after_the_answer_began_is_only_logged(caplog):
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        run_context(app, {"type": "http", "method": "GET"})
    errors = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert errors == ["unexpected error at /x"]


def test_rejected_stream_has_an_id(api):
    with pytest.raises(Exception) as refused, api.websocket_connect("/nowhere"):  # noqa: PT011
        pass
    assert MADE.fullmatch(refused.value.headers["x-request-id"])


def test_accepted_stream_has_an_id():
    async def app(scope, receive, send):
        await send({"type": "websocket.accept", "headers": [(b"a", b"b")]})
        await send({"type": "websocket.send", "bytes": b"untouched"})

    accepted, frame = run_context(app, {"type": "websocket", "headers": [(b"x-request-id", b"mine")]})
    assert accepted["headers"] == [(b"a", b"b"), (b"x-request-id", b"mine")]
    assert frame == {"type": "websocket.send", "bytes": b"untouched"}


@pytest.fixture
def threads():
    """Threads for observation batches."""
    with closing(IngestThreads()) as made:
        yield made


def test_ingest_threads_know_the_request_id(threads):
    async def send_request():
        request_id.set("batch-7")
        return await threads.run("arm", request_id.get)

    assert asyncio.run(send_request()) == "batch-7"


def test_batches_of_a_model_run_in_turn_without_blocking_others(threads):
    gate, order = threading.Event(), []

    async def send_request():
        slow = [asyncio.create_task(threads.run("slow", gate.wait)) for _ in range(5)]
        slow += [asyncio.create_task(threads.run("slow", order.append, number)) for number in range(5)]
        await asyncio.sleep(0)
        order.append(await threads.run("other", str, "other"))  # while the others wait
        gate.set()
        await asyncio.gather(*slow)

    asyncio.run(send_request())
    assert order == ["other", *range(5)]


HOT = "/v1/models/{model}/predict"
PREDICT = "/v1/models/panda-sim/predict"


@pytest.fixture
def lines(caplog):
    """Logged fields of requests, with the message."""
    caplog.set_level(logging.INFO, "service.requests")
    return lambda: [
        {"event": record.getMessage(), "level": record.levelname, **record.fields}
        for record in caplog.records
        if record.name == "service.requests"
    ]


def log_answer(log, status=200, seconds=0.001, route=HOT, code="", **scope):
    kind = Kind("POST", route, "m", status, code)
    log.log_end({"type": "http", "method": "POST", "path": "/v1/x", **scope}, kind, seconds)


def test_request_has_a_line(api, lines, monkeypatch):
    monkeypatch.setattr(RequestLog, "_count_skipped", lambda *_: 0)  # other tests have caused equal refusals
    answer = api.get("/v1/jobs/nobody?x=secret", headers={"authorization": "Bearer secret"})
    assert answer.status_code in (404, 422)
    (line,) = lines()
    assert line.pop("duration_ms") > 0
    asked = {"method": "GET", "route": "/v1/jobs/{job}", "path": "/v1/jobs/nobody", "client": "testclient"}
    answered = {"status": answer.status_code, "code": answer.json()["error"]["code"]}
    assert line == {"event": "request", "level": "INFO", **asked, **answered}


HEALTH = ["/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready", "/metrics"]


def test_successful_control_and_monitoring_requests_have_no_line(api, lines, monkeypatch):
    monkeypatch.setattr(RequestLog, "_count_skipped", lambda *_: 0)  # as above
    answers = [api.post(path, json=QUERY) for path in (PREDICT, "/v1/echo")] + [api.get(path) for path in HEALTH]
    assert [each.status_code for each in answers] == [200] * len(answers)
    assert not [line for line in lines() if "slow" not in line]
    assert api.post(PREDICT, json={"q": [1]}).status_code == 422
    (line,) = (line for line in lines() if "slow" not in line)
    assert (line["route"], line["status"], line["code"]) == (HOT, 422, "invalid_request")


def test_successful_reading_has_no_line(api, lines):
    assert api.get("/v1/models").status_code == 200
    assert lines() == []
    assert api.get("/v1/models/nobody").status_code == 404
    assert [line["route"] for line in lines()] == ["/v1/models/{model}"]


def test_slow_control_request_has_a_line(caplog, lines):
    log = RequestLog([HOT], slow_s=0.25, max_refusals=10)
    assert not log.may_log("POST", HOT, 0.249)
    assert log.may_log("POST", HOT, 0.25)
    for seconds in (0.249, 0.25):
        log_answer(log, seconds=seconds)
    assert [(line["duration_ms"], line["slow"]) for line in lines()] == [(250.0, True)]
    caplog.clear()
    caplog.set_level(logging.DEBUG, "service.requests")
    assert log.may_log("POST", HOT, 0.001)
    log_answer(log)
    assert [line["level"] for line in lines()] == ["DEBUG"]


def test_failure_is_a_warning_that_names_the_key(lines):
    log_answer(RequestLog([], 1.0, 10), 503, code="not_ready", **{KEY_ID: "key_1"})
    (line,) = lines()
    assert (line["level"], line["key"], line["code"]) == ("WARNING", "key_1", "not_ready")


def test_equal_rejections_are_counted(lines, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(requests, "monotonic", lambda: now[0])
    log = RequestLog([], slow_s=1.0, max_refusals=3)
    for _ in range(50):
        log_answer(log, 401, code="unauthorized")
    log_answer(log, 404, code="not_found")  # a rejection of another kind
    assert [line["status"] for line in lines()] == [401, 401, 401, 404]
    now[0] += 1.0
    for _ in range(2):
        log_answer(log, 401, code="unauthorized")
    assert [line.get("not_logged") for line in lines()] == [None, None, None, None, 47, None]


def test_long_address_is_truncated(lines):
    log_answer(RequestLog([], 1.0, 10), 404, route="", path="/" + "x" * 5000, method="Y" * 5000)
    (line,) = lines()
    assert len(line["path"]) == 200
    assert len(line["method"]) <= 16


def test_upload_has_a_line_without_its_content(api, lines):
    upload(api, stream(samples=40, seed=77), name="private-name")
    (line,) = lines()
    assert (line["route"], line["status"]) == ("/v1/datasets", 201)
    assert "private-name" not in str(line)


@pytest.fixture
def spans(monkeypatch):
    """Finished spans of a tracer of this process."""
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    monkeypatch.setitem(EXTRAS, "opentelemetry", Extra("send traces", ()))
    return exporter.get_finished_spans


def client(home, **settings):
    # the application is not started: the echo needs no service
    return TestClient(create_app(Settings(home=home, **settings)), ADDRESS)


def test_request_is_a_span_with_route_and_id(spans, home):
    parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    headers = {"x-request-id": "mine", "traceparent": parent}
    assert client(home, opentelemetry=True).post("/v1/echo", json={}, headers=headers).status_code == 200
    (span,) = (span for span in spans() if span.kind is trace.SpanKind.SERVER)
    assert span.name == "POST /v1/echo"
    assert span.attributes["lipserve.request_id"] == "mine"
    assert f"{span.context.trace_id:032x}" in parent


def test_monitoring_is_not_traced(spans, home):
    assert client(home, opentelemetry=True).get("/health/live").status_code == 200
    assert client(home).post("/v1/echo", json={}).status_code == 200
    assert spans() == ()


def test_missing_package_error_names_the_extra(monkeypatch, home):
    monkeypatch.setitem(EXTRAS, "opentelemetry", Extra("send traces", ("opentelemetry.exporter.nowhere",)))
    with pytest.raises(MissingExtraError, match=r"pip install 'lipserve\[opentelemetry\]'"):
        client(home, opentelemetry=True)


def test_log_line_names_its_trace():
    record = logging.getLogger("x").makeRecord("x", logging.INFO, __file__, 1, "said", (), None)
    with TracerProvider().get_tracer("t").start_as_current_span("s") as span:
        line = logs._formatter("json").format(record)
    assert f'"trace_id": "{span.get_span_context().trace_id:032x}"' in line
