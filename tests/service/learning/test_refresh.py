"""Refreshing a version: what it learns from, what it becomes, and where it is refused."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from service.foundation.states import RUNNING
from service.journal import log
from service.storage.database import JobRow
from service.training import worker
from service.training.material import observed
from tests.service.data import QUICK, arrays, ended, running, stream, train, upload
from tests.service.learning.lessons import LESSON, Pupil, answered, lesson
from tests.service.server import Server

NAMES = (f"refreshed-{number}" for number in count())
LONG = {"hyperparameter_samples": 40, "posterior_samples": 40, "max_iterations": 30, "starts": 1}
"""A fit of a few seconds, on seven joints."""


@pytest.fixture
def pupil(school):
    """A model that nobody else uses, whose data set the service does not have."""
    return school.enrol(next(NAMES))


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
    pupil.put("learning", {"contact_threshold": 1e6, "on_change": "learn", "auto_refresh": False})
    pupil.teach(0, 1, 2, 3)
    answer = school.client.post(pupil.url("refresh"), json={})
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return pupil, dataset, ended(school.client, job["id"])


def test_a_refresh_is_a_job_that_makes_a_candidate(school, refreshed):
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


def test_a_version_that_a_user_trains_learns_from_the_newest_event_on(school, pupil):
    pupil.teach(0, 1)
    dataset = upload(school.client, stream())["id"]
    train(school.client, pupil.model, dataset)
    assert (start_of(school, pupil.model, 1), start_of(school, pupil.model, 2)) == (0, 2)
    assert pupil.predict()["version"] == 2
    assert pupil.predict()["revision"] == 0


def test_a_second_refresh_waits_for_the_first(waiting, pupil):
    pupil.teach(0, 1, 2)
    job = answered_202(pupil)
    said = pupil.refused("POST", "refresh", 409, "conflict", json={})
    assert job["id"] in said["message"]
    cancel(pupil, job)
    cancel(pupil, answered_202(pupil))


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


def test_requests_that_are_refused(school, pupil):
    assert (
        pupil.refused("POST", "refresh", 422, "invalid_request", json={"version": 1})["detail"][0]["field"] == "version"
    )
    pupil.refused("POST", "refresh", 422, "invalid_request")
    Pupil(school.client, "nobody").refused("POST", "refresh", 404, "not_found", json={})


def test_what_is_taken_back_while_it_is_trained_on_fails_the_job(waiting, pupil, monkeypatch):
    pupil.teach(0, 1, 2, 3)
    job, service = answered_202(pupil), waiting.service
    fit = worker.fit_model

    def slowly(*given, **more):
        pupil.delete("observations/arm/1")
        return fit(*given, **more)

    monkeypatch.setattr(worker, "fit_model", slowly)
    worker.run(service.settings, job["id"])
    seen = answered(pupil.client.get(f"/v1/jobs/{job['id']}"))
    assert (seen["state"], seen["error"]["code"]) == ("failed", "observations_taken_back")
    assert answered(pupil.client.get(f"/v1/models/{pupil.model}"))["latest_version"] == 1


def test_unlearnt_rows_are_not_trained_on(waiting, pupil):
    pupil.teach(0, 1, 2, 3)
    pupil.delete("observations/arm/1")
    job, service = answered_202(pupil), waiting.service
    with service.database.session() as session:
        request = session.query(JobRow).filter_by(id=job["id"]).one().request
    found = observed(service.settings, service.database, service.files, pupil.model, request)
    expected = np.concatenate([lesson(number)["tau"] for number in (0, 2, 3)])
    np.testing.assert_array_equal(found.samples.tau, expected)
    cancel(pupil, job)


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
        answered(server.client.put("/v1/models/arm/learning", json={"contact_threshold": 1e6}))
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
