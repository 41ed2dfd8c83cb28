"""Jobs that cannot be done say so and leave everything else as it was."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from service.training import worker
from tests.service.data import ended, error, job, queue, service_of, stream, train, upload


def test_lost_samples_fail_the_job_with_its_reason(api, monkeypatch):
    service = service_of(api)
    dataset = upload(api, stream(seed=11))["id"]
    with monkeypatch.context() as patch:
        patch.setattr(service.jobs, "submit", lambda job: None)
        name = queue(api, "lost", dataset)["id"]
    service.files.delete_samples(dataset)
    service.jobs.submit(name)
    seen = ended(api, name)
    assert (seen["state"], seen["version"], seen["attempts"]) == ("failed", None, 1)
    assert seen["error"]["code"] == "damaged_data"
    assert dataset in seen["error"]["message"]
    assert seen["finished_at"]
    error(api.get("/v1/models/lost"), 404, "not_found")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_that_is_not_there_fails_the_job(api, pendulum):
    name = queue(api, "gpu", pendulum["id"], options={"device": "cuda", "max_iterations": 1})["id"]
    seen = ended(api, name)
    assert seen["state"] == "failed"
    assert "no CUDA device is available" in seen["error"]["message"]


def test_torques_without_any_variation_do_not_stop_the_worker(api, pendulum):
    """Whatever becomes of such a job, it ends, and the next one runs."""
    still = stream(seed=12)
    still = type(still)(still.joint_names, still.t, still.episode, still.q, still.dq, still.ddq, np.zeros_like(still.q))
    assert ended(api, queue(api, "still", upload(api, still)["id"])["id"])["attempts"] == 1
    train(api, "after-still", pendulum["id"])


def test_an_attempt_that_was_superseded_publishes_nothing(api, pendulum, monkeypatch):
    """A service that was killed and started again hands the job to another process while the first may still run."""
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "superseded", pendulum["id"])["id"]
    save = worker.lipcore.save

    def lose_and_save(*args):
        service.jobs.recover()
        return save(*args)

    monkeypatch.setattr(worker.lipcore, "save", lose_and_save)
    worker.run(service.settings, name)
    assert job(api, name)["state"] == "queued"
    error(api.get("/v1/models/superseded"), 404, "not_found")

    monkeypatch.setattr(worker.lipcore, "save", save)
    worker.run(service.settings, name)
    seen = job(api, name)
    assert (seen["state"], seen["version"], seen["attempts"]) == ("succeeded", 1, 2)


def test_a_job_is_run_once_even_if_it_is_handed_out_twice(api, pendulum, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "once", pendulum["id"])["id"]
    for _ in range(2):
        worker.run(service.settings, name)
    assert job(api, name)["attempts"] == 1
    assert api.get("/v1/models/once").json()["latest_version"] == 1
