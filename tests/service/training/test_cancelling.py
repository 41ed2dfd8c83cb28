"""Cancelling jobs: queued ones end at once, running ones soon, ended ones are left unchanged."""

import pytest

from service.training import planned_fit, worker
from tests.service.data import ENDLESS, ended, error, eventually, job, queue, running, service_of, stream, upload


@pytest.fixture(scope="module")
def panda(api):
    """A data set whose fit takes long."""
    return upload(api, stream("panda", 200))["id"]


@pytest.mark.slow
def test_queued_job_is_cancelled_at_once_and_never_runs(api, panda, pendulum):
    ahead = queue(api, "ahead", panda, options=ENDLESS)["id"]
    running(api, ahead)
    waiting = queue(api, "waiting", pendulum["id"])["id"]
    answer = api.post(f"/v1/jobs/{waiting}/cancel")
    assert answer.status_code == 200
    assert answer.json()["state"] == "cancelled"
    assert answer.json()["finished_at"]

    api.post(f"/v1/jobs/{ahead}/cancel")
    behind = queue(api, "behind", pendulum["id"])["id"]
    assert ended(api, behind)["state"] == "succeeded"  # so the queue has skipped the cancelled job
    seen = job(api, waiting)
    assert (seen["state"], seen["attempts"], seen["version"]) == ("cancelled", 0, None)
    error(api.get("/v1/models/waiting"), 404, "not_found")


def test_running_job_is_cancelled_without_a_version(api, panda):
    folders = set(service_of(api).files.versions.iterdir())
    name = queue(api, "stopped", panda, options=ENDLESS)["id"]
    running(api, name)
    assert api.post(f"/v1/jobs/{name}/cancel").status_code == 200
    seen = ended(api, name)
    assert (seen["state"], seen["version"], seen["error"]) == ("cancelled", None, None)
    assert seen["finished_at"]
    error(api.get("/v1/models/stopped"), 404, "not_found")
    assert set(service_of(api).files.versions.iterdir()) == folders


def test_cancel_while_the_model_is_saved_takes_effect(api, pendulum, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "late", pendulum["id"])["id"]
    save = worker.lipcore.save

    def cancel_and_save(*args):
        assert api.post(f"/v1/jobs/{name}/cancel").json()["state"] == "running"
        return save(*args)

    monkeypatch.setattr(worker.lipcore, "save", cancel_and_save)
    worker.run(service.settings, name)
    assert job(api, name)["state"] == "cancelled"
    error(api.get("/v1/models/late"), 404, "not_found")


def test_cancel_while_all_rows_are_learnt_takes_effect(api, pendulum, monkeypatch):
    service, refit = service_of(api), planned_fit.refit
    monkeypatch.setattr(service.jobs, "submit", lambda job: None)
    name = queue(api, "last-fit", pendulum["id"], holdout={"share": 0.3})["id"]

    def cancel_and_refit(model, task):
        assert job(api, name)["progress"]["fraction"] < 1
        assert api.post(f"/v1/jobs/{name}/cancel").json()["state"] == "running"
        eventually(task.cancelled)
        return refit(model, task)

    monkeypatch.setattr(planned_fit, "refit", cancel_and_refit)
    worker.run(service.settings, name)
    seen = job(api, name)
    assert (seen["state"], seen["version"]) == ("cancelled", None)
    assert seen["progress"]["stage"] == "all_rows"
    error(api.get("/v1/models/last-fit"), 404, "not_found")


def test_ended_job_cannot_be_cancelled(api, pendulum):
    name = queue(api, "ended", pendulum["id"])["id"]
    before = ended(api, name)
    assert before["state"] == "succeeded"
    assert "succeeded" in error(api.post(f"/v1/jobs/{name}/cancel"), 409, "conflict")["message"]
    assert job(api, name) == before
