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


@pytest.mark.parametrize(
    ("module", "step", "stage", "holdout"),
    [(worker.lipcore, "save", "saving", None), (planned_fit, "refit", "all_rows", {"share": 0.3})],
    ids=["save", "all-rows"],
)
def test_cancel_during_a_late_step_takes_effect(api, pendulum, run_here, monkeypatch, module, step, stage, holdout):
    model, complete = f"late-{step}", getattr(module, step)
    name = queue(api, model, pendulum["id"], holdout=holdout)["id"]

    def cancel_and_complete(*given):
        assert job(api, name)["progress"]["fraction"] < 1
        assert api.post(f"/v1/jobs/{name}/cancel").json()["state"] == "running"
        if step == "refit":
            eventually(given[1].cancelled)
        return complete(*given)

    monkeypatch.setattr(module, step, cancel_and_complete)
    seen = run_here(name)
    assert (seen["state"], seen["version"], seen["progress"]["stage"]) == ("cancelled", None, stage)
    error(api.get(f"/v1/models/{model}"), 404, "not_found")


def test_ended_job_cannot_be_cancelled(api, pendulum):
    name = queue(api, "ended", pendulum["id"])["id"]
    before = ended(api, name)
    assert before["state"] == "succeeded"
    assert "succeeded" in error(api.post(f"/v1/jobs/{name}/cancel"), 409, "conflict")["message"]
    assert job(api, name) == before
