"""Refreshing a version: triggers, training data, result, and alarms."""

import time
from datetime import UTC, datetime
from unittest.mock import patch

import pytest

from lipserve.states import CANCELLED, FAILED, RUNNING
from service.journal import log
from service.learning import refresh
from service.learning.learner.publication import Publication
from service.learning.refresh import RefreshRule
from service.storage.database import AlarmRow, JobRow, VersionRow, now
from service.training import planned_fit, worker
from tests.service.data import QUICK, arrays, ended, running, stream, train, upload
from tests.service.learning.learning_models import BATCH_ROWS, LearningModel, read_json
from tests.service.server import Server

LONG_FIT_OPTIONS = {"hyperparameter_samples": 40, "posterior_samples": 40, "max_iterations": 30, "starts": 1}
"""Options of a fit of a few seconds on seven joints."""


@pytest.fixture
def idle_jobs_service(learning_service, monkeypatch):
    """Service in which queued jobs stay queued."""
    with monkeypatch.context() as patch:
        patch.setattr(learning_service.service.jobs, "submit", lambda job: None)
        yield learning_service


def accept_job(client, path):
    """Return the job that a request queues."""
    answer = client.post(path, json={})
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return job


def request_refresh(learning_model):
    return accept_job(learning_model.client, learning_model.url("refresh"))


def cancel_job(learning_model, job):
    assert learning_model.client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200


@pytest.mark.slow
def test_refresh_of_few_rows_is_a_candidate_with_the_options_of_the_version(learning_service):
    learning_model = LearningModel(learning_service.client, "asked")
    client, url = learning_model.client, f"/v1/models/{learning_model.name}"
    dataset = upload(client, stream(), name="recorded")["id"]
    train(client, learning_model.name, dataset, robot=None, options={**QUICK, "max_iterations": 5})
    learning_model.put("learning", {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False})
    learning_model.send_batches(0, 1, 2, 3)
    job = ended(client, request_refresh(learning_model)["id"])
    assert (job["state"], job["version"], job["datasets"]) == ("succeeded", 2, [dataset])
    assert job["refresh"] == {"version": 1, "through": 4, "trigger": "asked"}
    shown = read_json(client.get(url))
    assert (shown["latest_version"], shown["serving_version"]) == (2, 1)
    with learning_service.service.database.session() as session:
        assert log.start_of(session, learning_model.name, 2) == 4

    old, new = (read_json(client.get(f"{url}/versions/{number}")) for number in (1, 2))
    for name in ("estimator", "joint_names", "joint_types", "torque_convention", "options"):
        assert new[name] == old[name]
    assert new["lineage"]["datasets"] == old["lineage"]["datasets"]
    log_lineage = new["lineage"]["log"]
    assert (log_lineage["through"], log_lineage["rows"], log_lineage["found"]) == (4, 4 * BATCH_ROWS, 4 * BATCH_ROWS)
    assert 0 < log_lineage["last"] - log_lineage["first"] < 1
    assert new["fit"]["samples_given"] == new["fit"]["samples_posterior"] == 80 + 4 * BATCH_ROWS


def test_second_refresh_is_rejected_while_one_is_queued(idle_jobs_service, learning_model):
    learning_model.send_batches(0, 1, 2)
    job = request_refresh(learning_model)
    assert job["id"] in learning_model.expect_error("POST", "refresh", 409, "conflict", json={})["message"]
    cancel_job(learning_model, job)
    cancel_job(learning_model, request_refresh(learning_model))


def test_refresh_replaces_obsolete_gpu_option(idle_jobs_service, learning_model):
    """Earlier releases trained every estimator with `device: "cuda"`."""
    learning_model.send_batches(0, 1, 2)
    with idle_jobs_service.service.database.transaction() as session:
        version = session.get_one(VersionRow, (learning_model.name, 1))
        version.manifest = {**version.manifest, "options": {**version.manifest["options"], "device": "cuda"}}
    job = request_refresh(learning_model)
    with idle_jobs_service.service.database.session() as session:
        row = session.query(JobRow).filter_by(id=job["id"]).one()
        assert row.request["options"]["device"] == "auto"
    cancel_job(learning_model, job)


def test_refresh_without_data_is_rejected(learning_model):
    learning_model.send_batches(0, 1)
    message = learning_model.expect_error("POST", "refresh", 409, "conflict", json={})["message"]
    for words in ("20 rows", "at least 30", "it has been deleted"):
        assert words in message


def test_unlearning_during_training_fails_the_job(idle_jobs_service, learning_model, monkeypatch):
    learning_model.send_batches(0, 1, 2, 3)
    job, fit = request_refresh(learning_model), planned_fit.fit_model

    def fit_after_unlearning(*given, **more):
        learning_model.delete("observations/arm/1")
        return fit(*given, **more)

    monkeypatch.setattr(planned_fit, "fit_model", fit_after_unlearning)
    worker.run(idle_jobs_service.service.settings, job["id"])
    seen = read_json(learning_model.client.get(f"/v1/jobs/{job['id']}"))
    assert (seen["state"], seen["error"]["code"]) == ("failed", "observations_taken_back")
    assert read_json(learning_model.client.get(f"/v1/models/{learning_model.name}"))["latest_version"] == 1


def test_retried_refresh_uses_the_current_log(idle_jobs_service, learning_model):
    learning_model.send_batches(0, 1, 2)
    job = request_refresh(learning_model)
    learning_model.send_batches(3)
    cancel_job(learning_model, job)
    again = accept_job(learning_model.client, f"/v1/jobs/{job['id']}/retry")
    assert again["retry_of"] == job["id"]
    assert again["refresh"] == {**job["refresh"], "through": job["refresh"]["through"] + 1}
    reply = learning_model.client.post(f"/v1/jobs/{job['id']}/retry").json()["error"]
    assert (reply["code"], again["id"] in reply["message"]) == ("conflict", True)  # a refresh is queued already
    cancel_job(learning_model, again)


@pytest.mark.slow
def test_refresh_continues_after_service_kill(tmp_path):
    recorded, moved = stream("panda", 60), stream("panda", 40, seed=2)
    body = {name: values.tolist() for name, values in arrays(moved).items()}
    with Server(tmp_path / "home") as server:
        dataset = upload(server.client, recorded)["id"]
        train(server.client, "arm", dataset, options=LONG_FIT_OPTIONS)
        read_json(server.client.put("/v1/models/arm/learning", json={"contact_threshold": 100.0}))
        read_json(server.client.post("/v1/models/arm/observations", json={"stream_id": "s", "sequence": 0, **body}))
        job = server.client.post("/v1/models/arm/refresh", json={}).json()
        assert running(server.client, job["id"])["state"] == RUNNING
        server.kill()
    with Server(tmp_path / "home") as server:
        seen = ended(server.client, job["id"])
        assert (seen["state"], seen["attempts"], seen["version"]) == ("succeeded", 2, 2)
        assert seen["refresh"] == job["refresh"]
        shown = read_json(server.client.get("/v1/models/arm"))
        assert ([each["version"] for each in shown["versions"]], shown["serving_version"]) == ([1, 2], 1)
        lineage = read_json(server.client.get("/v1/models/arm/versions/2"))["lineage"]
        assert lineage["log"]["rows"] == 40


def consider_refresh(learning_service, learning_model, share=0.5, version=1, errors=None, pause=0.0, observed=0.0):
    """Consider a refresh after a publication; return the job, if any. By default few rows are enough, at any time."""
    service = learning_service.service
    published = Publication(learning_model.name, version, 3, 3, None, 30.0, 900, share, 0.1, time.time(), errors)
    with patch.multiple(refresh, RULE=RefreshRule(pause_s=pause), MIN_OBSERVED_S=observed):
        return refresh.queue_refresh(service.database, service.jobs, published)


def list_alarms(learning_model):
    return [(each["kind"], each["message"]) for each in learning_model.get("alarms")["items"]]


@pytest.fixture
def refreshable_model(idle_jobs_service, learning_model):
    """Model that can be refreshed, with automatic refreshes enabled."""
    learning_model.send_batches(0, 1, 2)
    learning_model.put("learning", {})
    yield idle_jobs_service, learning_model
    for job in learning_model.client.get("/v1/jobs", params={"limit": 100}).json()["items"]:
        if job["model"] == learning_model.name and job["state"] == "queued":
            cancel_job(learning_model, job)


def test_novel_motion_triggers_one_refresh_and_one_alarm(refreshable_model):
    learning_service, learning_model = refreshable_model
    with learning_service.service.database.session() as session:
        newest = log.newest(session, learning_model.name)
    job = consider_refresh(*refreshable_model)
    assert job.refresh.model_dump() == {"version": 1, "through": newest, "trigger": "novelty"}
    assert consider_refresh(*refreshable_model) is None
    [(kind, message)] = list_alarms(learning_model)
    assert kind == "novelty"
    assert "50 % of the last 2000 samples" in message


@pytest.mark.parametrize(
    "circumstances",
    [{"share": 0.2}, {"version": 2}, {"observed": 60.0}, {"share": 0.0, "errors": (0.1, 0.4)}],
    ids=["little novelty", "another version", "few observations", "small linearisation error"],
)
def test_no_refresh_without_reason(refreshable_model, circumstances):
    assert consider_refresh(*refreshable_model, **circumstances) is None
    assert list_alarms(refreshable_model[1]) == []


def test_large_linearisation_error_triggers_refresh(refreshable_model):
    job = consider_refresh(*refreshable_model, share=0.0, errors=(0.1, 0.8))
    assert job.refresh.trigger == "linearisation"
    [alarm] = refreshable_model[1].get("alarms")["items"]
    assert alarm["kind"] == "linearisation"
    assert "80 % of the stated error" in alarm["message"]
    assert alarm["evidence"]["linearisation_error"] == [0.1, 0.8]
    assert alarm["evidence"]["job"] == job.id


def test_paused_model_is_not_refreshed(refreshable_model):
    learning_service, learning_model = refreshable_model
    with learning_service.service.database.transaction() as session:
        refresh.owner.pause(session, learning_model.name, {"at": 0.0, "event": 1})
    assert consider_refresh(learning_service, learning_model) is None
    with learning_service.service.database.transaction() as session:
        refresh.owner.resume(session, learning_model.name)
    assert consider_refresh(learning_service, learning_model) is not None


def test_pauses_between_refreshes_grow(refreshable_model):
    def finish_job(job, state):
        """End a job as of 500 s ago."""
        with refreshable_model[0].service.database.transaction() as session:
            row = session.query(JobRow).filter_by(id=job.id).one()
            row.state, row.finished_at = state, datetime.fromtimestamp(time.time() - 500.0, UTC).isoformat()

    finish_job(consider_refresh(*refreshable_model), FAILED)
    assert consider_refresh(*refreshable_model, pause=600.0) is None
    finish_job(consider_refresh(*refreshable_model, pause=400.0), CANCELLED)
    assert consider_refresh(*refreshable_model, pause=400.0) is None
    assert consider_refresh(*refreshable_model, pause=240.0) is not None


def test_impossible_refresh_raises_one_alarm(idle_jobs_service, learning_model):
    learning_model.send_batches(0)
    learning_model.put("learning", {})
    for _ in range(2):
        assert consider_refresh(idle_jobs_service, learning_model) is None
    [(kind, message)] = list_alarms(learning_model)
    assert kind == "refresh"
    assert "10 rows" in message


def test_disabled_refresh_raises_one_alarm_per_reason(idle_jobs_service, learning_model):
    learning_model.send_batches(0, 1, 2)
    for _ in range(2):
        assert consider_refresh(idle_jobs_service, learning_model, errors=(0.6, 0.0)) is None
    assert sorted(kind for kind, _ in list_alarms(learning_model)) == ["linearisation", "novelty"]


def test_no_refresh_while_a_better_candidate_waits(refreshable_model):
    learning_service, learning_model = refreshable_model
    learning_model.put("learning", {"auto_promote": False})
    with learning_service.service.database.transaction() as session:
        evidence = {"serving": 1, "candidate": 2, "verdict": "promote"}
        session.add(AlarmRow(model=learning_model.name, kind="promotion", at=now(), message="", evidence=evidence))
    assert consider_refresh(learning_service, learning_model) is None
    learning_model.put("learning", {"auto_promote": True})
    assert consider_refresh(learning_service, learning_model) is not None
