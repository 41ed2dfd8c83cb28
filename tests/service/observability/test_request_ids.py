"""Every answer names its request, whatever becomes of it, and so does what is done and logged for it."""

from __future__ import annotations

import asyncio
import logging
import re

import pytest
from fastapi.testclient import TestClient

from service.compute.process import Place
from service.inference import predicting as inference
from service.learning.learners import IngestThreads
from service.web.observability.logs import given_request_id, new_request_id, request_id
from service.web.observability.meters import Meters
from service.web.observability.requests import RequestContext, RequestLog
from tests.service.data import ADDRESS

MADE = re.compile(r"[0-9a-f]{12}-[0-9a-f]+")
QUERY = {"q": [0.0] * 7, "dq": [0.0] * 7, "ddq": [0.0] * 7}


def context(app):
    """The middleware around an application."""
    return RequestContext(app, Meters(), RequestLog((), slow_s=1.0, most_refusals=1))


def talk(app, scope):
    """What an application sends through the middleware."""
    sent = []

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(context(app)({"headers": [], "path": "/x", "app": None, **scope}, receive, send))
    return sent


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/health/live", 200),
        ("GET", "/v1/models", 200),
        ("GET", "/nowhere", 404),
        ("PATCH", "/v1/models", 405),
        ("POST", "/v1/models/panda-sim/predict", 200),
        ("POST", "/v1/models/nobody/predict", 404),
        ("GET", "/v2/models/nobody", 404),
    ],
)
def test_every_answer_has_an_id_of_its_own(api, method, path, status):
    answers = [api.request(method, path, json=QUERY if method == "POST" else None) for _ in range(2)]
    assert [each.status_code for each in answers] == [status, status]
    first, second = (each.headers["x-request-id"] for each in answers)
    assert MADE.fullmatch(first)
    assert MADE.fullmatch(second)
    assert first != second


@pytest.mark.parametrize("given", ["a", "7f3a9c", "robot-1.loop_2", "x" * 64])
def test_an_id_that_was_given_comes_back(api, given):
    assert api.get("/v1/models", headers={"x-request-id": given}).headers["x-request-id"] == given


@pytest.mark.parametrize(
    "given", [b"", b" ", b"a b", b"x" * 65, b"a/b", b'a"b', b"a;b", b"<a>", b"-._", b"caf\xe9", b"\xc2\xb2"]
)
def test_an_id_that_could_do_harm_is_replaced(api, given):
    answer = api.get("/v1/models", headers={b"x-request-id": given})
    assert MADE.fullmatch(answer.headers["x-request-id"])


def test_the_first_of_two_ids_counts():
    assert given_request_id([(b"x-request-id", b"one"), (b"x-request-id", b"two")]) == "one"
    assert given_request_id([(b"x-request-id", b"a\r\nset-cookie: b"), (b"x-request-id", b"two")]) is None


def test_ids_that_are_made_can_be_given():
    made = new_request_id()
    assert given_request_id([(b"x-request-id", made.encode())]) == made


def test_an_unexpected_error_is_answered_and_logged_with_its_id(api, monkeypatch, caplog):
    seen = []

    class Ids(logging.Handler):
        def emit(self, record):
            seen.append((record.getMessage(), request_id.get()))

    def broken(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr(inference, "predict", broken)
    handler = Ids()
    logging.getLogger("service.foundation.errors").addHandler(handler)
    try:
        quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
        answer = quiet.post(
            "/v1/models/panda-sim/predict", json={**QUERY, "components": ["gravity"]}, headers={"x-request-id": "mine"}
        )
    finally:
        logging.getLogger("service.foundation.errors").removeHandler(handler)
    assert (answer.status_code, answer.headers["x-request-id"]) == (500, "mine")
    assert seen == [("unexpected error at POST /v1/models/panda-sim/predict", "mine")]


def test_an_unexpected_error_goes_on_to_the_server(api, monkeypatch):
    def broken(*_):
        raise RuntimeError("whoever runs the tests wants to see it")

    monkeypatch.setattr(inference, "predict", broken)
    with pytest.raises(RuntimeError, match="wants to see it"):
        api.post("/v1/models/panda-sim/predict", json={**QUERY, "components": ["gravity"]})


def test_a_failure_after_the_answer_began_is_logged_and_not_answered_again(caplog):
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        talk(app, {"type": "http", "method": "GET"})
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == [
        "unexpected error at /x"
    ]


def test_a_refused_stream_has_an_id(api):
    with pytest.raises(Exception) as refused, api.websocket_connect("/nowhere"):  # noqa: PT011
        pass
    assert MADE.fullmatch(refused.value.headers["x-request-id"])


def test_an_accepted_stream_has_an_id():
    async def app(scope, receive, send):
        await send({"type": "websocket.accept", "headers": [(b"a", b"b")]})
        await send({"type": "websocket.send", "bytes": b"untouched"})

    accepted, frame = talk(app, {"type": "websocket", "headers": [(b"x-request-id", b"mine")]})
    assert accepted["headers"] == [(b"a", b"b"), (b"x-request-id", b"mine")]
    assert frame == {"type": "websocket.send", "bytes": b"untouched"}


def test_threads_that_take_observations_know_the_request():
    async def ask():
        request_id.set("batch-7")
        return await threads.run(request_id.get)

    threads = IngestThreads(Place(threads=1))
    try:
        assert asyncio.run(ask()) == "batch-7"
    finally:
        threads.close()
