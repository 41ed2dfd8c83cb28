"""Readiness: each part that fails is named and checked again, but not more often than necessary."""

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

FAST_OPTIONS = {**QUICK, "posterior_samples": 40}
"""Options of a fit within the limits of the strict service."""
PARTS = ["database", "home", "models", "learner", "training"]


class Clock:
    """A clock that stands still until `now` is changed."""

    now = 1000.0

    def __call__(self):
        return self.now


class VersionUses:
    """Records the threads that use a version: others learn and predict at the same time."""

    def __init__(self, numbers):
        self.numbers, self.threads = numbers, []

    def __next__(self):
        self.threads.append(get_ident())
        return next(self.numbers)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def set_learner(monkeypatch):
    """Return a function that sets figures of the learner process, which is needed and runs."""

    def set_figures(**figures):
        for name, value in figures.items():
            monkeypatch.setattr(LearnerProcess, name, value)

    set_figures(is_needed=True, pid=1)
    return set_figures


@pytest.fixture
def check_readiness(clock):
    """Check the parts of a service without its cache; return their states."""
    kept = {}

    def check_readiness(service):
        seen = kept.setdefault(id(service.readiness), Readiness(service.readiness.probes, service.stopping, clock))
        seen.forget()
        return {check.name: (check.state, check.message) for check in seen.report()}

    return check_readiness


def test_every_part_and_its_failure_are_named(api, fresh_readiness, monkeypatch):
    service = service_of(api)
    answer = api.get("/health/ready")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["status"], answer.json()["version"]) == ("ready", __version__)
    assert [part["name"] for part in answer.json()["checks"] if part["name"] != "files"] == PARTS
    for owner, name, value, field in (
        (service.stopping, "begun", True, "stopping"),
        (service.disk, "floor", 2**62, "home"),
    ):
        service.readiness.forget()
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            refusal = error(api.get("/health/ready"), 503, "not_ready")
            assert api.get("/health/live").json() == {"status": "alive"}
        assert [item["field"] for item in refusal["detail"]] == [field]
    assert "LIPSERVE_MIN_FREE_BYTES" in refusal["message"]


@pytest.mark.own_files("locks the file of the database")
def test_locked_database_is_reported(api, check_readiness, monkeypatch):
    monkeypatch.setattr(storage, "WRITE_S", 0.05)
    service = service_of(api)
    with closing(sqlite3.connect(service.database.engine.url.database, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        assert check_readiness(service)["database"] == ("failed", "OperationalError: database is locked")
    assert check_readiness(service)["database"][0] == "ok"


def test_unwritable_home_is_reported_without_its_path(api, check_readiness, monkeypatch, tmp_path):
    service = service_of(api)
    monkeypatch.setattr(service.files, "uploads", tmp_path / "gone")
    state, message = check_readiness(service)["home"]
    assert state == "failed"
    assert "gone" not in message  # this route needs no key


def test_check_and_scrape_do_not_count_as_uses_of_a_version(api, trained, check_readiness, set_learner, monkeypatch):
    service = service_of(api)
    service.learners.monitor(trained.name)  # a version with an alias is checked
    files, uses = list(service.files.uploads.iterdir()), VersionUses(service.loaded._clock)
    monkeypatch.setattr(service.loaded, "_clock", uses)
    assert check_readiness(service)["learner"] == ("ok", "runs")
    assert list(service.files.uploads.iterdir()) == files
    assert list(LearningCollector(service.learners).collect())
    assert get_ident() not in uses.threads
    service.loaded.get(trained.name, 1)
    assert get_ident() in uses.threads  # a request uses it


def test_unreadable_version_is_a_warning_while_others_work(api, trained, check_readiness, monkeypatch):
    service = service_of(api)
    service.loaded.get(trained.name, 1)
    before = check_readiness(service)["models"]
    monkeypatch.setattr(service.loaded, "unreadable", lambda: {(trained.name, 1): "damaged"})
    assert check_readiness(service)["models"] == before  # a version in memory works whatever its files are
    monkeypatch.setattr(service.loaded, "versions", set)
    state, message = check_readiness(service)["models"]
    assert state == "warning"
    assert message.startswith("1 of ")
    assert trained.name not in message
    monkeypatch.setattr(service.files, "has_version", lambda folder: False)
    assert check_readiness(service)["models"][0] == "failed"


def test_missing_or_hanging_learner_is_reported_after_a_while(api, check_readiness, clock, set_learner):
    service = service_of(api)
    set_learner(pid=None)
    for seconds, state in ((0.0, "warning"), (RESTART_S, "warning"), (1.0, "failed")):
        clock.now += seconds
        assert check_readiness(service)["learner"][0] == state
    set_learner(pid=1)
    assert check_readiness(service)["learner"] == ("ok", "runs")
    set_learner(pid=None)
    assert check_readiness(service)["learner"][0] == "warning"  # missing again
    set_learner(pid=1, silent_s=RESTART_S)
    assert check_readiness(service)["learner"] == ("ok", "runs")
    set_learner(silent_s=44.0)
    message = "has made no progress for 44 s: observations are stored, but not learnt"
    assert check_readiness(service)["learner"] == ("failed", message)


def test_observations_that_wait_long_are_reported(api, trained, check_readiness, clock, set_learner, monkeypatch):
    service, limit, newest = service_of(api), MAX_LAG_S, 57
    service.loaded.get(trained.name, None)
    monkeypatch.setattr(service.learners, "monitors", lambda: {trained.name: None})
    monkeypatch.setattr(log, "newest", lambda session, model: newest)
    for seconds in (0.0, 1.0):  # they have just arrived
        clock.now += seconds
        assert check_readiness(service)["learner"] == ("ok", "runs")
    clock.now += limit + 1.0
    message = f"runs, but 57 events are waiting and none was learnt for {limit + 1.0:.0f} s"
    assert check_readiness(service)["learner"] == ("warning", message)
    newest = 0
    assert check_readiness(service)["learner"] == ("ok", "runs")


def test_jobs_that_nobody_starts_are_reported(no_worker, check_readiness, clock):
    service = service_of(no_worker)
    job = queue(no_worker, "waits-for-health", upload(no_worker, stream())["id"], options=FAST_OPTIONS)["id"]
    assert check_readiness(service)["training"] == ("ok", "1 job waiting, 0 running")
    clock.now += START_S + 1.0
    assert check_readiness(service)["training"][0] == "failed"
    assert no_worker.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    assert check_readiness(service)["training"][0] == "ok"


def test_report_is_cached_briefly(api, clock):
    looked = []
    probes = {"home": lambda lasting: looked.append(1) or ("ok", "")}
    seen = Readiness(probes, service_of(api).stopping, clock)
    for _ in range(5):
        seen.report()
    assert len(looked) == 1
    clock.now += MAX_REPORT_AGE_S
    seen.report()
    assert len(looked) == 2
