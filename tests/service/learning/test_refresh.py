"""Refreshing a version: when it is, what it learns from, what it becomes, and when its owner is told instead."""

import time
from datetime import UTC, datetime
from unittest.mock import patch

import pytest
from sqlalchemy import select

from lipserve.states import CANCELLED, FAILED, RUNNING
from service.journal import log
from service.learning import refresh
from service.learning.learner.publication import Publication
from service.learning.refresh import RefreshRule
from service.storage.database import AlarmRow, JobRow, VersionRow, now
from service.training import planned_fit, worker
from tests.service.data import QUICK, arrays, ended, running, stream, train, upload
from tests.service.learning.lessons import LESSON, Pupil, answered
from tests.service.server import Server

LONG = {"hyperparameter_samples": 40, "posterior_samples": 40, "max_iterations": 30, "starts": 1}
"""A fit of a few seconds, on seven joints."""


@pytest.fixture
def waiting(school, monkeypatch):
    """The service, where queued jobs stay queued."""
    with monkeypatch.context() as patch:
        patch.setattr(school.service.jobs, "submit", lambda job: None)
        yield school


def cancel(pupil, job):
    assert pupil.client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 200


def start_of(school, model, version):
    with school.service.database.session() as session:
        return log.start_of(session, model, version)


@pytest.fixture(scope="module")
def refreshed(school):
    """A model with a data set, some observations, and a refresh that was asked for; its job."""
    pupil = Pupil(school.client, "asked")
    dataset = upload(school.client, stream(), name="recorded")
    train(school.client, pupil.model, dataset["id"], robot=None, options={**QUICK, "max_iterations": 5})
    pupil.put("learning", {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False})
    pupil.teach(0, 1, 2, 3)
    answer = school.client.post(pupil.url("refresh"), json={})
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return pupil, dataset, ended(school.client, job["id"])


def test_a_refresh_with_too_few_rows_to_compare_waits(school, refreshed):
    pupil, dataset, job = refreshed
    assert (job["state"], job["version"], job["datasets"]) == ("succeeded", 2, [dataset["id"]])
    assert job["refresh"] == {"version": 1, "through": 4, "trigger": "asked"}
    shown = answered(school.client.get(f"/v1/models/{pupil.model}"))
    assert (shown["latest_version"], shown["serving_version"]) == (2, 1)
    assert start_of(school, pupil.model, 2) == 4


def test_a_refresh_trains_as_the_version_was_trained(school, refreshed):
    pupil, _, _ = refreshed
    old, new = (answered(school.client.get(f"/v1/models/{pupil.model}/versions/{number}")) for number in (1, 2))
    for name in ("estimator", "joint_names", "joint_types", "torque_convention", "options"):
        assert new[name] == old[name]
    assert new["lineage"]["datasets"] == old["lineage"]["datasets"]
    log_said = new["lineage"]["log"]
    assert (log_said["through"], log_said["rows"], log_said["found"]) == (4, 4 * LESSON, 4 * LESSON)
    assert 0 < log_said["last"] - log_said["first"] < 1
    assert new["fit"]["samples_given"] == new["fit"]["samples_posterior"] == 80 + 4 * LESSON


def test_a_second_refresh_waits_for_the_first(waiting, pupil):
    pupil.teach(0, 1, 2)
    job = answered_202(pupil)
    said = pupil.refused("POST", "refresh", 409, "conflict", json={})
    assert job["id"] in said["message"]
    cancel(pupil, job)
    cancel(pupil, answered_202(pupil))


def test_a_refresh_leaves_out_a_gpu_that_the_estimator_no_longer_uses(waiting, pupil):
    """Earlier releases trained every estimator with `device: "cuda"`."""
    pupil.teach(0, 1, 2)
    with waiting.service.database.transaction() as session:
        version = session.scalars(select(VersionRow).where(VersionRow.model == pupil.model)).one()
        version.manifest = {**version.manifest, "options": {**version.manifest["options"], "device": "cuda"}}
    job = answered_202(pupil)
    with waiting.service.database.session() as session:
        row = session.scalars(select(JobRow).where(JobRow.id == job["id"])).one()
        assert row.request["options"]["device"] == "auto"
    cancel(pupil, job)


def answered_202(pupil):
    answer = pupil.client.post(pupil.url("refresh"), json={})
    assert answer.status_code == 202, answer.text
    return answer.json()


def test_without_data_there_is_nothing_to_refresh_from(pupil):
    pupil.teach(0, 1)
    said = pupil.refused("POST", "refresh", 409, "conflict", json={})
    assert "20 rows" in said["message"]
    assert "at least 30" in said["message"]
    assert "it has been deleted" in said["message"]


def test_what_is_taken_back_while_it_is_trained_on_fails_the_job(waiting, pupil, monkeypatch):
    pupil.teach(0, 1, 2, 3)
    job, service = answered_202(pupil), waiting.service
    fit = planned_fit.fit_model

    def slowly(*given, **more):
        pupil.delete("observations/arm/1")
        return fit(*given, **more)

    monkeypatch.setattr(planned_fit, "fit_model", slowly)
    worker.run(service.settings, job["id"])
    seen = answered(pupil.client.get(f"/v1/jobs/{job['id']}"))
    assert (seen["state"], seen["error"]["code"]) == ("failed", "observations_taken_back")
    assert answered(pupil.client.get(f"/v1/models/{pupil.model}"))["latest_version"] == 1


def test_a_repeated_refresh_starts_from_what_is_known_now(waiting, pupil):
    pupil.teach(0, 1, 2)
    job = answered_202(pupil)
    pupil.teach(3)
    cancel(pupil, job)
    answer = pupil.client.post(f"/v1/jobs/{job['id']}/retry")
    assert answer.status_code == 202, answer.text
    again = answer.json()
    assert again["retry_of"] == job["id"]
    assert again["refresh"] == {**job["refresh"], "through": job["refresh"]["through"] + 1}
    said = pupil.client.post(f"/v1/jobs/{job['id']}/retry").json()["error"]
    assert (said["code"], again["id"] in said["message"]) == ("conflict", True)  # it is being refreshed already
    cancel(pupil, again)


@pytest.mark.slow
def test_a_refresh_goes_on_after_the_service_was_killed(tmp_path):
    recorded, moved = stream("panda", 60), stream("panda", 40, seed=2)
    body = {name: values.tolist() for name, values in arrays(moved).items()}
    with Server(tmp_path / "home") as server:
        dataset = upload(server.client, recorded)["id"]
        train(server.client, "arm", dataset, options=LONG)
        answered(server.client.put("/v1/models/arm/learning", json={"contact_threshold": 100.0}))
        answered(server.client.post("/v1/models/arm/observations", json={"stream_id": "s", "sequence": 0, **body}))
        job = server.client.post("/v1/models/arm/refresh", json={}).json()
        assert running(server.client, job["id"])["state"] == RUNNING
        server.kill()
    with Server(tmp_path / "home") as server:
        seen = ended(server.client, job["id"])
        assert (seen["state"], seen["attempts"], seen["version"]) == ("succeeded", 2, 2)
        assert seen["refresh"] == job["refresh"]
        shown = answered(server.client.get("/v1/models/arm"))
        assert ([each["version"] for each in shown["versions"]], shown["serving_version"]) == ([1, 2], 1)
        lineage = answered(server.client.get("/v1/models/arm/versions/2"))["lineage"]
        assert lineage["log"]["rows"] == 40


def published(pupil, share=0.5, version=1, errors=None):
    return Publication(pupil.model, version, 3, 3, None, 30.0, 900, share, 0.1, time.time(), errors)


def consider(school, pupil, **changes):
    service = school.service
    with patch.object(refresh, "RULE", RefreshRule(pause_s=changes.pop("pause", 0.0))):
        return refresh.queue_refresh(service.database, service.jobs, published(pupil, **changes))


def alarms(pupil):
    return [(each["kind"], each["message"]) for each in pupil.get("alarms")["items"]]


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Few rows are enough to be refreshed by itself."""
    monkeypatch.setattr(refresh, "MIN_OBSERVED_S", 0.0)


@pytest.fixture
def ready(waiting, pupil):
    """A model that can be refreshed, whose owner wants it to be."""
    pupil.teach(0, 1, 2)
    pupil.put("learning", {})
    yield waiting, pupil
    for job in pupil.client.get("/v1/jobs", params={"limit": 100}).json()["items"]:
        if job["model"] == pupil.model and job["state"] == "queued":
            cancel(pupil, job)


def test_much_novel_motion_leads_to_one_refresh_and_one_alarm(ready):
    job = consider(*ready)
    assert job.refresh.model_dump() == {"version": 1, "through": log_end(*ready), "trigger": "novelty"}
    [(kind, message)] = alarms(ready[1])
    assert kind == "novelty"
    assert "50 % of the last 2000 samples" in message
    assert consider(*ready) is None
    assert len(alarms(ready[1])) == 1


def log_end(school, pupil):
    with school.service.database.session() as session:
        return log.newest(session, pupil.model)


@pytest.mark.parametrize("changes", [{"share": 0.2}, {"version": 2}])
def test_little_novelty_or_another_version_leads_to_nothing(ready, changes):
    assert consider(*ready, **changes) is None
    assert alarms(ready[1]) == []


def test_an_arm_that_has_left_its_linearisation_is_refreshed(ready):
    assert consider(*ready, share=0.0, errors=(0.1, 0.4)) is None
    job = consider(*ready, share=0.0, errors=(0.1, 0.8))
    assert job.refresh.trigger == "linearisation"
    [alarm] = ready[1].get("alarms")["items"]
    assert alarm["kind"] == "linearisation"
    assert "80 % of the stated error" in alarm["message"]
    assert alarm["evidence"]["linearisation_error"] == [0.1, 0.8]
    assert alarm["evidence"]["job"] == job.id


def test_a_model_that_is_held_is_not_refreshed(ready):
    school, pupil = ready
    with school.service.database.transaction() as session:
        refresh.owner.pause(session, pupil.model, {"at": 0.0, "event": 1})
    assert consider(school, pupil) is None
    with school.service.database.transaction() as session:
        refresh.owner.resume(session, pupil.model)
    assert consider(school, pupil) is not None


def test_a_version_that_has_observed_too_little_to_be_compared_is_not_refreshed(ready, monkeypatch):
    monkeypatch.setattr(refresh, "MIN_OBSERVED_S", 60.0)
    assert consider(*ready) is None


def test_refreshes_pause_and_each_longer_than_the_one_before(ready):
    school, pupil = ready

    def passed(job, state, seconds):
        at = datetime.fromtimestamp(time.time() - seconds, UTC).isoformat()
        with school.service.database.transaction() as session:
            row = session.query(JobRow).filter_by(id=job.id).one()
            row.state, row.finished_at = state, at

    passed(consider(school, pupil), FAILED, 500.0)
    assert consider(school, pupil, pause=600.0) is None
    second = consider(school, pupil, pause=400.0)
    passed(second, CANCELLED, 500.0)
    assert consider(school, pupil, pause=400.0) is None
    assert consider(school, pupil, pause=240.0) is not None


def test_an_impossible_refresh_is_told_once(waiting, pupil):
    pupil.teach(0)
    pupil.put("learning", {})
    for _ in range(2):
        assert consider(waiting, pupil) is None
    [(kind, message)] = alarms(pupil)
    assert kind == "refresh"
    assert "10 rows" in message


def test_every_reason_is_told_once_where_refreshes_are_not_wanted(waiting, pupil):
    pupil.teach(0, 1, 2)
    for _ in range(2):
        assert consider(waiting, pupil, errors=(0.6, 0.0)) is None
    assert sorted(kind for kind, _ in alarms(pupil)) == ["linearisation", "novelty"]


def test_an_owner_who_was_told_of_a_better_version_is_not_offered_more(ready):
    school, pupil = ready
    pupil.put("learning", {"auto_promote": False})
    with school.service.database.transaction() as session:
        told = {"serving": 1, "candidate": 2, "verdict": "promote"}
        session.add(AlarmRow(model=pupil.model, kind="promotion", at=now(), message="", evidence=told))
    assert consider(school, pupil) is None
    pupil.put("learning", {"auto_promote": True})
    assert consider(school, pupil) is not None
