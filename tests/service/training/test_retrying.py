"""Retries of jobs, and the history of a job."""

import pytest

from tests.service.data import error, job, queue, stream, upload

MODEL = "repeated"


@pytest.fixture
def cancelled(no_worker):
    """A cancelled job and its data set."""
    dataset = upload(no_worker, stream())["id"]
    options = {"hyperparameter_samples": 20, "posterior_samples": 30, "max_iterations": 2}
    name = queue(no_worker, MODEL, dataset, options=options)["id"]
    no_worker.post(f"/v1/jobs/{name}/cancel")
    return name, dataset


def retry(api, name):
    return api.post(f"/v1/jobs/{name}/retry")


def test_retry_is_a_new_job_with_the_same_request(no_worker, cancelled):
    name, dataset = cancelled
    answer = retry(no_worker, name)
    assert answer.status_code == 202
    again, before = answer.json(), job(no_worker, name)
    assert answer.headers["location"] == f"/v1/jobs/{again['id']}"
    assert again["id"] != name
    assert (again["retry_of"], again["state"], again["attempts"]) == (name, "queued", 0)
    assert [entry["message"] for entry in again["history"]] == [f"queued to repeat {name}"]
    for field in ("model", "datasets", "estimator", "robot", "refresh"):
        assert again[field] == before[field]
    assert (before["state"], before["retry_of"]) == ("cancelled", None)

    assert "is queued" in error(retry(no_worker, again["id"]), 409, "conflict")["message"]
    no_worker.post(f"/v1/jobs/{again['id']}/cancel")
    no_worker.delete(f"/v1/datasets/{dataset}")
    message = error(retry(no_worker, again["id"]), 409, "conflict")["message"]
    assert dataset in message
    assert again["id"] in message


def test_succeeded_job_is_not_retried(api, trained):
    made = api.get(f"/v1/models/{trained.name}/versions/1").json()["job"]
    assert "is succeeded" in error(retry(api, made), 409, "conflict")["message"]


def test_job_shows_its_request_and_its_history(no_worker, cancelled):
    name, _ = cancelled
    answer = no_worker.post(f"/v1/jobs/{name}/retry", headers={"X-Request-ID": "who-asked-7"}).json()
    assert answer["request_id"] == "who-asked-7"
    after = no_worker.post(f"/v1/jobs/{answer['id']}/cancel").json()
    last = {"at": after["finished_at"], "state": "cancelled", "message": "cancelled while waiting"}
    assert [entry["state"] for entry in after["history"]] == ["queued", "cancelled"]
    assert after["history"][-1] == last
