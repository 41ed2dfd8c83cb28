"""Health, and the one shape of every error, wherever it comes from."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from service import __version__
from service.inference import predicting as inference
from tests.service.data import ADDRESS, error, service_of


def test_alive(api):
    answer = api.get("/health/live")
    assert (answer.status_code, answer.json()) == (200, {"status": "alive"})


def test_ready(api):
    answer = api.get("/health/ready")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["status"], answer.json()["version"]) == ("ready", __version__)


def test_not_ready_while_the_database_does_not_answer(api, monkeypatch, fresh_looks):
    def broken():
        raise OSError("disk on fire")

    monkeypatch.setattr(service_of(api).database, "session", broken)
    assert "disk on fire" in error(api.get("/health/ready"), 503, "not_ready")["message"]
    assert api.get("/health/live").status_code == 200


@pytest.mark.parametrize("path", ["/dashboard", "/nowhere", "/v1", "/v1/models/x/y", "/v1/datasets/../../etc"])
def test_unknown_routes(api, path):
    error(api.get(path), 404, "not_found")


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("PUT", "/v1/datasets"),
        ("DELETE", "/v1/jobs"),
        ("GET", "/v1/models/panda-sim/predict"),
        ("POST", "/health/live"),
        ("PATCH", "/v1/models"),
    ],
)
def test_wrong_methods(api, method, path):
    answer = api.request(method, path)
    error(answer, 405, "method_not_allowed")
    allowed = answer.headers["allow"].split(", ")
    assert set(allowed) <= {"GET", "HEAD", "POST", "DELETE"} - {method}


def test_unexpected_errors_tell_nothing_of_the_inside(api, monkeypatch):
    def broken(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr(inference, "predict", broken)
    # the same application without a start of its own
    quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
    answer = quiet.post("/v1/models/panda-sim/predict", json={"q": [0], "dq": [0], "ddq": [0]})
    assert "secret" not in str(error(answer, 500, "internal_error"))


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/jobs", b'{"model": "\\ud800", "datasets": ["a"]}'),
        ("/v1/jobs", b'{"model": "a", "datasets": ["\\udfff"]}'),
        ("/v1/models/panda-sim/predict", b'{"q": [0], "dq": [0], "ddq": [0], "\\ud800": 1}'),
        ("/v1/models/panda-sim/evaluate", b'{"dataset": "\\ud800"}'),
    ],
)
def test_half_characters_are_refused(api, path, body):
    error(api.post(path, content=body, headers={"content-type": "application/json"}), 422, "invalid_request")


def test_many_wrong_fields_give_a_short_answer(api):
    body = {"model": "a", "datasets": list(range(5000))}
    assert len(error(api.post("/v1/jobs", json=body), 422, "invalid_request")["detail"]) == 20


def test_a_long_field_name_is_cut(api):
    said = error(api.post("/v1/jobs", json={"model": "a", "datasets": ["a"], "x" * 9000: 1}), 422, "invalid_request")
    assert len(said["message"]) < 500
