"""Requests with an idempotency key: repeated requests are processed once."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.service.data import QUICK, arrays, ended, error, npz, service_of, stream, upload
from tests.service.server import Server

KEY = "Idempotency-Key"


def body(seed=81):
    return npz(**arrays(stream(seed=seed)))


def post(api, key, content=None, **params):
    headers = {"content-type": "application/x-npz", KEY: key}
    return api.post("/v1/datasets", content=body() if content is None else content, headers=headers, params=params)


def at_once(ask):
    """Send a request six times at once; return status and id of the one object that was made."""
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: ask(), range(6)))
    (made,) = {(answer.status_code, answer.json()["id"]) for answer in answers}
    return made


def queue(api, key, dataset, model="by-key", **more):
    request = {"model": model, "datasets": [dataset], "estimator": "lip-chain", "options": QUICK, **more}
    return api.post("/v1/jobs", json=request, headers={KEY: key})


def test_repeated_upload_makes_one_data_set(api):
    first, again = (post(api, "up-1", name="a") for _ in range(2))
    check_repeated(first, again, 201)
    assert again.json() == first.json()
    assert post(api, "up-2", name="a").json()["id"] != first.json()["id"]


def check_repeated(first, again, status):
    """Check that both answers are about the same object."""
    assert (first.status_code, again.status_code) == (status, status)
    assert again.json()["id"] == first.json()["id"]
    assert again.headers["location"] == first.headers["location"]


@pytest.mark.parametrize("change", [{"name": "b"}, {"cutoff": 5}, {"content": body(seed=82)}])
def test_other_upload_with_the_same_key_is_a_conflict(api, change):
    made = post(api, "up-3", name="a").json()["id"]
    refusal = error(post(api, "up-3", **{"name": "a", **change}), 409, "conflict")
    assert (refusal["detail"][0]["field"], made in refusal["message"]) == (KEY, True)


def test_rejected_or_deleted_upload_frees_its_key(api):
    error(post(api, "up-4", b"no archive"), 422, "invalid_data")
    made = post(api, "up-4").json()["id"]
    assert api.delete(f"/v1/datasets/{made}").status_code == 204
    again = post(api, "up-4")
    assert (again.status_code, again.json()["id"] != made) == (201, True)


def test_concurrent_uploads_make_one_data_set(api):
    folder = service_of(api).files.datasets
    before = {path.name for path in folder.iterdir()}
    status, made = at_once(lambda: post(api, "up-6"))
    assert status == 201
    assert {path.name for path in folder.iterdir()} - before == {f"{made}.safetensors", f"{made}.recording"}


def test_repeated_request_queues_one_job(api, pendulum):
    first, again = (queue(api, "job-1", pendulum["id"]) for _ in range(2))
    check_repeated(first, again, 202)
    ended(api, first.json()["id"])
    late = queue(api, "job-1", pendulum["id"])
    assert (late.status_code, late.json()["state"]) == (202, "succeeded")  # the job as it is now
    refusal = error(queue(api, "job-1", pendulum["id"], "another"), 409, "conflict")
    assert "job-1 was used by another request" in refusal["message"]
    assert post(api, "job-1").status_code == 201  # keys of data sets are apart


def test_concurrent_requests_queue_one_job(api, pendulum):
    status, made = at_once(lambda: queue(api, "job-2", pendulum["id"], "at-once"))
    assert (status, ended(api, made)["state"]) == (202, "succeeded")


def test_repeated_request_finds_its_job_after_data_set_deletion(api):
    dataset = upload(api, stream(seed=83))["id"]
    made = queue(api, "job-3", dataset, "known").json()["id"]
    ended(api, made)
    assert api.delete(f"/v1/datasets/{dataset}").status_code == 204
    assert queue(api, "job-3", dataset, "known").json()["id"] == made
    error(queue(api, "job-4", dataset, "known"), 404, "not_found")


def test_repeated_retry_queues_one_job(api, pendulum):
    failed = queue(api, "job-5", pendulum["id"], "retried", options={"max_iterations": 10_000}).json()["id"]
    assert api.post(f"/v1/jobs/{failed}/cancel").status_code == 200
    ended(api, failed)
    first, again = (api.post(f"/v1/jobs/{failed}/retry", headers={KEY: "retry-1"}) for _ in range(2))
    check_repeated(first, again, 202)
    assert first.json()["retry_of"] == failed
    error(queue(api, "retry-1", pendulum["id"]), 409, "conflict")
    api.post(f"/v1/jobs/{first.json()['id']}/cancel")
    ended(api, first.json()["id"])


@pytest.mark.slow
def test_idempotency_keys_survive_a_killed_service(home):
    with Server(home) as server:
        dataset = post(server.client, "kept").json()
        job = queue(server.client, "kept", dataset["id"]).json()["id"]
        server.kill()
    with Server(home) as server:
        assert post(server.client, "kept").json() == dataset
        assert queue(server.client, "kept", dataset["id"]).json()["id"] == job
        assert [each["id"] for each in server.client.get("/v1/jobs").json()["items"]] == [job]
        error(queue(server.client, "kept", dataset["id"], "another"), 409, "conflict")
