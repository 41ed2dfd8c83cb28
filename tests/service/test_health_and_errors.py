"""Health, and the one shape of every error, wherever it comes from."""

from fastapi.testclient import TestClient

from service import __version__
from service.inference import predicting as inference
from tests.service.data import ADDRESS, error, service_of


def test_alive_and_ready(api):
    assert api.get("/health/live").json() == {"status": "alive"}
    answer = api.get("/health/ready")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["status"], answer.json()["version"]) == ("ready", __version__)


def test_not_ready_while_the_database_does_not_answer(api, monkeypatch, fresh_looks):
    def broken():
        raise OSError("disk on fire")

    monkeypatch.setattr(service_of(api).database, "session", broken)
    assert "disk on fire" in error(api.get("/health/ready"), 503, "not_ready")["message"]
    assert api.get("/health/live").status_code == 200


def test_unexpected_errors_tell_nothing_of_the_inside(api, monkeypatch):
    def broken(*_):
        raise RuntimeError("secret")

    monkeypatch.setattr(inference, "predict", broken)
    # the same application without a start of its own
    quiet = TestClient(api.app, ADDRESS, raise_server_exceptions=False)
    answer = quiet.post("/v1/models/panda-sim/predict", json={"q": [0], "dq": [0], "ddq": [0]})
    assert "secret" not in str(error(answer, 500, "internal_error"))


def test_many_wrong_fields_and_long_names_give_a_short_answer(api):
    body = {"model": "a", "datasets": list(range(5000)), "x" * 9000: 1}
    problem = error(api.post("/v1/jobs", json=body), 422, "invalid_request")
    assert len(problem["detail"]) == 20
    assert max(len(each["field"]) for each in problem["detail"]) < 500
