"""When a version is refreshed by itself, and when its owner is told instead."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from itertools import count

import pytest

import lipcore
from service.foundation.states import CANCELLED, FAILED
from service.journal import log
from service.learning import refresh
from service.learning.learner.publication import Published
from service.models import registry
from service.storage.database import AlarmRow, JobRow, now

NAMES = (f"considered-{number}" for number in count())


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


def published(pupil, share=0.5, version=1, errors=None):
    return Published(pupil.model, version, 3, 3, None, 30.0, 900, share, 0.1, time.time(), errors)


def consider(school, pupil, **changes):
    service = school.service
    settings = service.settings.model_copy(update={"refresh_pause_s": changes.pop("pause", 0.0)})
    return refresh.consider(settings, service.database, service.jobs, published(pupil, **changes))


def alarms(pupil):
    return [(each["kind"], each["message"]) for each in pupil.get("alarms")["items"]]


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
    assert "50% of the last 2000 samples" in message
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
    assert "80% of the stated error" in alarm["message"]
    assert alarm["evidence"]["linearisation_error"] == [0.1, 0.8]
    assert alarm["evidence"]["job"] == job.id


def test_a_model_that_is_held_is_not_refreshed(ready):
    school, pupil = ready
    with school.service.database.transaction() as session:
        refresh.owner.hold(session, pupil.model, {"at": 0.0, "event": 1})
    assert consider(school, pupil) is None
    with school.service.database.transaction() as session:
        refresh.owner.release(session, pupil.model)
    assert consider(school, pupil) is not None


def test_a_candidate_in_contest_is_waited_for(ready):
    school, pupil = ready
    with school.service.files.new_version(f"mv_{pupil.model}_2") as target:
        manifest = lipcore.copy_model(school.trained, target)
    with school.service.database.transaction() as session:
        registry.publish(session, pupil.model, f"mv_{pupil.model}_2", manifest, None, candidate=True)
    assert consider(school, pupil) is None


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


def test_novelty_is_told_once_where_refreshes_are_not_wanted(waiting, pupil):
    pupil.teach(0, 1, 2)
    for _ in range(2):
        assert consider(waiting, pupil) is None
    assert [kind for kind, _ in alarms(pupil)] == ["novelty"]


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
