"""One line a request, none for a control loop that is answered in time, and never what a client wants kept."""

from __future__ import annotations

import logging

import pytest

from service.web.observability import requests
from service.web.observability.logs import KEY_ID
from service.web.observability.meters import Kind
from service.web.observability.requests import RequestLog
from tests.service.data import upload
from tests.service.observability.test_request_ids import QUERY

HOT = "/v1/models/{model}/predict"


@pytest.fixture
def lines(caplog):
    """Fields of what has been logged of requests, by the message."""
    caplog.set_level(logging.INFO, "service.requests")
    return lambda: [
        {"said": record.getMessage(), "level": record.levelname, **record.fields}
        for record in caplog.records
        if record.name == "service.requests"
    ]


def answered(log, status=200, seconds=0.001, route=HOT, code="", **scope):
    kind = Kind("POST", route, "m", status, code)
    log.answered({"type": "http", "method": "POST", "path": "/v1/x", **scope}, kind, seconds)


def test_a_request_has_a_line(api, lines):
    answer = api.get("/v1/jobs/nobody?x=secret", headers={"authorization": "Bearer secret"})
    assert answer.status_code in (404, 422)
    (line,) = lines()
    assert line.pop("duration_ms") > 0
    assert line == {
        "said": "request",
        "level": "INFO",
        "method": "GET",
        "route": "/v1/jobs/{job}",
        "path": "/v1/jobs/nobody",
        "client": "testclient",
        "status": answer.status_code,
        "code": answer.json()["error"]["code"],
    }


@pytest.mark.parametrize("path", ["/v1/models/panda-sim/predict", "/v1/echo"])
def test_a_control_loop_has_none(api, lines, path):
    assert api.post(path, json=QUERY).status_code == 200
    assert lines() == []


@pytest.mark.parametrize("path", ["/health/live", "/health/ready", "/v2/health/live", "/v2/health/ready", "/metrics"])
def test_monitoring_has_none(api, lines, path):
    assert api.get(path).status_code == 200
    assert lines() == []


def test_a_control_loop_has_one_where_it_is_wrong(api, lines):
    assert api.post("/v1/models/panda-sim/predict", json={"q": [1]}).status_code == 422
    (line,) = lines()
    assert (line["route"], line["status"], line["code"]) == (HOT, 422, "invalid_request")


def test_a_control_loop_has_one_where_it_is_slow(lines):
    log = RequestLog([HOT], slow_s=0.25, most_refusals=10)
    assert not log.may_log(HOT, 0.249)
    assert log.may_log(HOT, 0.25)
    answered(log, seconds=0.249)
    answered(log, seconds=0.25)
    assert [(line["duration_ms"], line["slow"]) for line in lines()] == [(250.0, True)]


def test_a_control_loop_has_one_at_debug(caplog, lines):
    caplog.set_level(logging.DEBUG, "service.requests")
    log = RequestLog([HOT], slow_s=0.25, most_refusals=10)
    assert log.may_log(HOT, 0.001)
    answered(log)
    assert [line["level"] for line in lines()] == ["DEBUG"]


def test_what_fails_is_a_warning_that_names_the_key(lines):
    answered(RequestLog([], 1.0, 10), 503, code="not_ready", **{KEY_ID: "key_1"})
    (line,) = lines()
    assert (line["level"], line["key"], line["code"]) == ("WARNING", "key_1", "not_ready")


def test_equal_refusals_are_counted_instead(lines, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(requests, "monotonic", lambda: now[0])
    log = RequestLog([], slow_s=1.0, most_refusals=3)
    for _ in range(50):
        answered(log, 401, code="unauthorized")
    answered(log, 404, code="not_found")  # of another sort
    assert [line["status"] for line in lines()] == [401, 401, 401, 404]
    now[0] += 1.0
    answered(log, 401, code="unauthorized")
    answered(log, 401, code="unauthorized")
    assert [line.get("not_logged") for line in lines()] == [None, None, None, None, 47, None]


def test_an_address_is_cut(lines):
    answered(RequestLog([], 1.0, 10), 404, route="", path="/" + "x" * 5000, method="Y" * 5000)
    (line,) = lines()
    assert len(line["path"]) == requests.SHOWN
    assert len(line["method"]) <= 16


def test_an_upload_has_a_line_without_what_it_holds(api, pendulum, lines):
    upload(api, pendulum_samples(), name="private-name")
    (line,) = lines()
    assert (line["route"], line["status"]) == ("/v1/datasets", 201)
    assert "private-name" not in str(line)


def pendulum_samples():
    from tests.service.data import stream

    return stream(samples=40, seed=77)
