"""Requests under a key of their client's: sent again, they are done once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from service.storage.database import DatasetRow, JobRow
from tests.service.data import QUICK, arrays, ended, error, npz, service_of, stream, upload
from tests.service.server import Server

KEY = "Idempotency-Key"


def body(seed=81):
    return npz(**arrays(stream(seed=seed)), joint_names=np.array(stream().joint_names))


def post(api, key, content=None, **params):
    headers = {"content-type": "application/x-npz", KEY: key}
    return api.post("/v1/datasets", content=body() if content is None else content, headers=headers, params=params)


def queue(api, key, dataset, model="by-key", **more):
    request = {"model": model, "datasets": [dataset], "estimator": "lip-chain", "options": QUICK, **more}
    return api.post("/v1/jobs", json=request, headers={KEY: key})


def test_an_upload_is_done_once(api):
    first = post(api, "up-1", name="a")
    again = post(api, "up-1", name="a")
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"]
    assert post(api, "up-2", name="a").json()["id"] != first.json()["id"]


@pytest.mark.parametrize("change", [{"name": "b"}, {"cutoff": 5}, {"content": body(seed=82)}])
def test_another_upload_under_the_same_key_is_a_conflict(api, change):
    made = post(api, "up-3", name="a").json()["id"]
    said = error(post(api, "up-3", **{"name": "a", **change}), 409, "conflict")
    assert (said["detail"][0]["field"], made in said["message"]) == (KEY, True)


def test_an_upload_that_was_refused_leaves_its_key_free(api):
    error(post(api, "up-4", b"no archive"), 422, "invalid_data")
    assert post(api, "up-4").status_code == 201


def test_with_its_data_set_a_key_is_deleted(api):
    made = post(api, "up-5").json()["id"]
    assert api.delete(f"/v1/datasets/{made}").status_code == 204
    again = post(api, "up-5")
    assert again.status_code == 201
    assert again.json()["id"] != made


def test_uploads_at_the_same_time_make_one_data_set(api):
    service = service_of(api)
    files = {path.name for path in service.files.datasets.iterdir()}
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: post(api, "up-6"), range(6)))
    assert {answer.status_code for answer in answers} == {201}
    (made,) = {answer.json()["id"] for answer in answers}
    assert {path.name for path in service.files.datasets.iterdir()} - files == {f"{made}.safetensors"}


def test_a_job_is_queued_once(api, pendulum):
    first = queue(api, "job-1", pendulum["id"])
    again = queue(api, "job-1", pendulum["id"])
    assert (first.status_code, again.status_code) == (202, 202)
    assert again.json()["id"] == first.json()["id"]
    assert again.headers["location"] == first.headers["location"]
    ended(api, first.json()["id"])
    late = queue(api, "job-1", pendulum["id"])
    assert (late.status_code, late.json()["state"]) == (202, "succeeded")  # the job as it is now
    said = error(queue(api, "job-1", pendulum["id"], "another"), 409, "conflict")
    assert "job-1, the key of another request" in said["message"]


def test_jobs_at_the_same_time_are_one(api, pendulum):
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: queue(api, "job-2", pendulum["id"], "at-once"), range(6)))
    assert {answer.status_code for answer in answers} == {202}
    (made,) = {answer.json()["id"] for answer in answers}
    ended(api, made)


def test_a_job_is_known_again_though_its_data_set_is_gone(api):
    dataset = upload(api, stream(seed=83))["id"]
    made = queue(api, "job-3", dataset, "known").json()["id"]
    ended(api, made)
    assert api.delete(f"/v1/datasets/{dataset}").status_code == 204
    assert queue(api, "job-3", dataset, "known").json()["id"] == made
    error(queue(api, "job-4", dataset, "known"), 404, "not_found")


def test_a_retry_is_queued_once(api, pendulum):
    failed = queue(api, "job-5", pendulum["id"], "retried", options={"max_iterations": 10_000}).json()["id"]
    assert api.post(f"/v1/jobs/{failed}/cancel").status_code == 200
    ended(api, failed)
    made = [api.post(f"/v1/jobs/{failed}/retry", headers={KEY: "retry-1"}) for _ in range(2)]
    assert [answer.status_code for answer in made] == [202, 202]
    first, again = (answer.json() for answer in made)
    assert first["id"] == again["id"]
    assert first["retry_of"] == failed
    error(queue(api, "retry-1", pendulum["id"]), 409, "conflict")
    api.post(f"/v1/jobs/{first['id']}/cancel")
    ended(api, first["id"])


def test_keys_of_data_sets_and_jobs_are_apart(api, pendulum):
    assert post(api, "both").status_code == 201
    answer = queue(api, "both", pendulum["id"], "apart")
    assert answer.status_code == 202
    ended(api, answer.json()["id"])


@pytest.mark.parametrize("key", ["", "x" * 101, "with space", "tab\there", "b\xfcchse"])
def test_keys_that_are_none(api, pendulum, key):
    sent = key.encode("latin-1")
    for answer in (
        api.post("/v1/datasets", content=body(), headers={"content-type": "application/x-npz", KEY: sent}),
        api.post("/v1/jobs", json={"model": "m", "datasets": [pendulum["id"]]}, headers={KEY: sent}),
    ):
        assert error(answer, 422, "invalid_request")["detail"][0]["field"] == KEY


def test_without_a_key_everything_is_done_each_time(api):
    assert upload(api, stream(seed=84))["id"] != upload(api, stream(seed=84))["id"]
    with service_of(api).database.session() as session:
        assert session.query(DatasetRow).filter(DatasetRow.idempotency_key.is_(None)).count() >= 2
        assert session.query(JobRow).filter(JobRow.idempotency_key == "").count() == 0


@pytest.mark.slow
def test_a_killed_service_still_knows(home):
    with Server(home) as server:
        dataset = post(server.client, "kept").json()
        job = queue(server.client, "kept", dataset["id"]).json()["id"]
        server.kill()
    with Server(home) as server:
        assert post(server.client, "kept").json() == dataset
        assert queue(server.client, "kept", dataset["id"]).json()["id"] == job
        assert [each["id"] for each in server.client.get("/v1/jobs").json()["items"]] == [job]
        error(queue(server.client, "kept", dataset["id"], "another"), 409, "conflict")
