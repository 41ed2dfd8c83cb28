"""Readiness: each part that does not work is named, looked at anew, and no more often than need be."""

import sqlite3
from contextlib import closing
from threading import get_ident

import pytest

from service import __version__
from service.journal import log
from service.learning.learner.process import LearnerProcess
from service.learning.learners import MAX_LAG_S, RESTART_S
from service.learning.metrics import LearningCollector
from service.storage import storage
from service.telemetry.readiness import MAX_REPORT_AGE_S, Readiness
from service.training.metrics import START_S
from tests.service.data import QUICK, error, queue, service_of, stream, upload

FEW = {**QUICK, "posterior_samples": 40}
"""Options of a fit as small as the strict service wants it."""
PARTS = ["database", "home", "models", "learner", "training"]


class Clock:
    """Time that stands still until `now` is changed."""

    now = 1000.0

    def __call__(self):
        return self.now


class Uses:
    """What counts uses of versions, and notes by which threads: others learn and answer meanwhile."""

    def __init__(self, numbers):
        self.numbers, self.threads = numbers, []

    def __next__(self):
        self.threads.append(get_ident())
        return next(self.numbers)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def look(clock):
    """A look at a service, as if nobody had looked within the last second: states by part."""
    kept = {}

    def look(service):
        seen = kept.setdefault(id(service.readiness), Readiness(service.readiness.probes, service.stopping, clock))
        seen.forget()
        return {check.name: (check.state, check.message) for check in seen.report()}

    return look


def test_all_parts_are_named_and_what_does_not_work(api, fresh_looks, monkeypatch):
    answer = api.get("/health/ready")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["status"], answer.json()["version"]) == ("ready", __version__)
    assert [part["name"] for part in answer.json()["checks"] if part["name"] != "files"] == PARTS  # these: if shared
    service_of(api).readiness.forget()
    monkeypatch.setattr(service_of(api).disk, "floor", 2**62)
    refusal = error(api.get("/health/ready"), 503, "not_ready")
    assert [item["field"] for item in refusal["detail"]] == ["home"]
    assert "LIPSERVE_MIN_FREE_BYTES" in refusal["message"]
    assert api.get("/health/live").json() == {"status": "alive"}


@pytest.mark.own_files("locks the file of the database")
def test_a_locked_database_is_found(api, look, monkeypatch):
    monkeypatch.setattr(storage, "WRITE_S", 0.05)
    service = service_of(api)
    with closing(sqlite3.connect(service.database.engine.url.database, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        assert look(service)["database"] == ("failed", "OperationalError: database is locked")
        other.execute("ROLLBACK")
    assert look(service)["database"][0] == "ok"


def test_a_home_that_cannot_be_written_is_found_and_not_named(api, look, monkeypatch, tmp_path):
    service = service_of(api)
    monkeypatch.setattr(service.files, "uploads", tmp_path / "gone")
    state, message = look(service)["home"]
    assert state == "failed"
    assert "gone" not in message  # whoever asks needs no key


def test_a_look_leaves_nothing_behind_and_like_a_scrape_does_not_count_as_using_a_version(
    api, trained, look, monkeypatch
):
    service = service_of(api)
    monkeypatch.setattr(LearnerProcess, "is_needed", True)
    monkeypatch.setattr(LearnerProcess, "pid", 1)
    service.learners.monitor(trained.name)  # what has one is looked at
    files, uses = list(service.files.uploads.iterdir()), Uses(service.loaded._clock)
    monkeypatch.setattr(service.loaded, "_clock", uses)
    assert look(service)["learner"] == ("ok", "runs")
    assert list(service.files.uploads.iterdir()) == files
    assert list(LearningCollector(service.learners).collect())
    assert get_ident() not in uses.threads
    service.loaded.get(trained.name, 1)
    assert get_ident() in uses.threads  # as whoever asks does use it


def test_versions_that_cannot_be_read_are_a_warning_while_others_can(api, trained, look, monkeypatch):
    service = service_of(api)
    service.loaded.get(trained.name, 1)
    before = look(service)["models"]
    monkeypatch.setattr(service.loaded, "unreadable", lambda: {(trained.name, 1): "damaged"})
    assert look(service)["models"] == before  # what is in memory answers whatever its files are
    monkeypatch.setattr(service.loaded, "versions", set)
    state, message = look(service)["models"]
    assert state == "warning"
    assert message.startswith("1 of ")
    assert trained.name not in message
    monkeypatch.setattr(service.files, "has_version", lambda folder: False)
    assert look(service)["models"][0] == "failed"


def test_a_learner_that_is_gone_for_long_is_found(api, look, clock, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(LearnerProcess, "is_needed", True)
    monkeypatch.setattr(LearnerProcess, "pid", None)
    assert look(service)["learner"][0] == "warning"
    clock.now += RESTART_S
    assert look(service)["learner"][0] == "warning"
    clock.now += 1.0
    assert look(service)["learner"][0] == "failed"
    monkeypatch.setattr(LearnerProcess, "pid", 1)
    assert look(service)["learner"] == ("ok", "runs")
    monkeypatch.setattr(LearnerProcess, "pid", None)
    assert look(service)["learner"][0] == "warning"  # gone anew


def test_a_learner_that_hangs_is_found(api, look, monkeypatch):
    service = service_of(api)
    monkeypatch.setattr(LearnerProcess, "is_needed", True)
    monkeypatch.setattr(LearnerProcess, "pid", 1)
    monkeypatch.setattr(LearnerProcess, "silent_s", RESTART_S)
    assert look(service)["learner"] == ("ok", "runs")
    monkeypatch.setattr(LearnerProcess, "silent_s", 44.0)
    message = "has not got on for 44 s: observations are stored, but not learnt"
    assert look(service)["learner"] == ("failed", message)


def test_observations_that_wait_for_long_are_found(api, trained, look, clock, monkeypatch):
    service = service_of(api)
    learners, limit = service.learners, MAX_LAG_S
    monkeypatch.setattr(LearnerProcess, "is_needed", True)
    monkeypatch.setattr(LearnerProcess, "pid", 1)
    service.loaded.get(trained.name, None)
    monkeypatch.setattr(learners, "monitors", lambda: {trained.name: None})
    newest = 57
    monkeypatch.setattr(log, "newest", lambda session, model: newest)
    assert look(service)["learner"] == ("ok", "runs")  # they have just come
    clock.now += 1.0
    assert look(service)["learner"] == ("ok", "runs")
    clock.now += limit + 1.0
    state, message = look(service)["learner"]
    assert state == "warning"
    assert message == f"runs, but 57 events wait, of which it has learnt none for {limit + 1.0:.0f} s"
    newest = 0
    assert look(service)["learner"] == ("ok", "runs")


def test_jobs_that_nobody_starts_are_found(no_worker, look, clock):
    service = service_of(no_worker)
    job = queue(no_worker, "waits-for-health", upload(no_worker, stream())["id"], options=FEW)["id"]
    assert look(service)["training"] == ("ok", "1 job waiting, 0 running")
    clock.now += START_S + 1.0
    assert look(service)["training"][0] == "failed"
    assert no_worker.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    assert look(service)["training"][0] == "ok"


def test_a_service_that_stops_is_not_ready_though_all_parts_work(api, monkeypatch):
    monkeypatch.setattr(service_of(api).stopping, "begun", True)
    refusal = error(api.get("/health/ready"), 503, "not_ready")
    assert [item["field"] for item in refusal["detail"]] == ["stopping"]


def test_a_report_is_kept_for_a_moment(api, clock):
    looked = []
    seen = Readiness(
        {"home": lambda lasting: looked.append(1) or ("ok", "")}, service_of(api).stopping, lambda: clock.now
    )
    for _ in range(5):
        seen.report()
    assert len(looked) == 1
    clock.now += MAX_REPORT_AGE_S
    seen.report()
    assert len(looked) == 2
