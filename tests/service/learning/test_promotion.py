"""What a verdict leads to: who answers, who learns, and what the owner is told."""

from __future__ import annotations

from itertools import count

import pytest
from sqlalchemy import select

import lipcore
from service.journal import log
from service.learning import refresh
from service.learning.learner.publication import Contested
from service.models import registry
from service.storage.database import LearnerRow
from tests.service.learning.lessons import answered

EVIDENCE = {"rows": 700, "gain": 0.5, "standard_error": 0.1}
NAMES = (f"promoted-{number}" for number in count())


@pytest.fixture
def pupil(school):
    """A model that nobody else uses."""
    return school.enrol(next(NAMES))


def publish(school, pupil, candidate=True, start=None):
    """Another version of a model, with the same torques."""
    folder = f"mv_{pupil.model}_{len(pupil.client.get(f'/v1/models/{pupil.model}').json()['versions'])}"
    with school.service.files.new_version(folder) as target:
        manifest = lipcore.copy_model(school.trained, target)
    with school.service.database.transaction() as session:
        return registry.publish(session, pupil.model, folder, manifest, None, candidate=candidate, start=start)


def decide(school, pupil, candidate=2, verdict="promote", serving=1):
    """Act on a verdict; return whether the candidate answers, and which models the learner was told of."""
    service, woken = school.service, []
    said = Contested(pupil.model, serving, candidate, verdict, EVIDENCE)
    return refresh.decide(service.database, service.loaded, woken.append, said), woken


def roles(school, pupil):
    """Role of each version."""
    with school.service.database.session() as session:
        rows = session.scalars(select(LearnerRow).where(LearnerRow.model == pupil.model))
        return {row.version: row.role for row in rows}


def serving(pupil):
    """Which version is said to answer, and which one does."""
    said = answered(pupil.client.get(f"/v1/models/{pupil.model}"))["serving_version"]
    return said, pupil.predict()["version"]


def test_a_better_candidate_answers_and_learns_from_then_on(school, pupil):
    assert serving(pupil) == (1, 1)
    publish(school, pupil)
    assert serving(pupil) == (1, 1)
    assert decide(school, pupil) == (True, [pupil.model])
    assert school.service.loaded.hot(pupil.model, None).version == 2
    assert serving(pupil) == (2, 2)
    assert roles(school, pupil) == {1: "dismissed", 2: "serving"}
    [alarm] = pupil.get("alarms")["items"]
    assert alarm["kind"] == "promotion"
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": True, **EVIDENCE}


def test_it_answers_with_what_it_has_learnt(school, pupil):
    pupil.teach(0, 1, 2)
    with school.service.database.session() as session:
        newest = log.newest(session, pupil.model)
    publish(school, pupil, start=newest - 2)
    before = pupil.predict()
    decide(school, pupil)
    after = pupil.predict()
    assert (before["version"], after["version"], after["revision"]) == (1, 2, 2)
    assert after["tau"] != before["tau"]


def test_one_that_is_not_better_is_dismissed_for_good(school, pupil):
    publish(school, pupil)
    assert decide(school, pupil, verdict="dismiss") == (False, [pupil.model])
    assert serving(pupil) == (1, 1)
    assert roles(school, pupil) == {1: "serving", 2: "dismissed"}
    [alarm] = pupil.get("alarms")["items"]
    assert (alarm["evidence"]["verdict"], alarm["evidence"]["promoted"]) == ("dismiss", False)
    assert decide(school, pupil) == (False, [])
    assert serving(pupil) == (1, 1)


def test_the_owner_may_decide_alone(school, pupil):
    pupil.put("learning", {"auto_promote": False})
    publish(school, pupil)
    assert decide(school, pupil) == (False, [pupil.model])
    assert serving(pupil) == (1, 1)
    [alarm] = pupil.get("alarms")["items"]
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": False, **EVIDENCE}
    assert "rollback to version 2" in alarm["message"]
    pupil.post("rollback", {"version": 2})
    assert serving(pupil) == (2, 2)


def test_a_verdict_on_a_version_that_serves_no_more_is_void(school, pupil):
    publish(school, pupil)
    publish(school, pupil, candidate=False)
    assert decide(school, pupil) == (False, [])
    assert serving(pupil) == (3, 3)
    assert pupil.get("alarms")["items"] == []


def test_one_that_knows_what_has_been_taken_back_is_dismissed(school, pupil):
    pupil.teach(0, 1)
    publish(school, pupil)
    pupil.delete("observations/arm/0")
    assert decide(school, pupil) == (False, [pupil.model])
    assert serving(pupil) == (1, 1)
    assert "taken back" in pupil.get("alarms")["items"][0]["message"]


def test_taking_back_what_came_later_does_not_matter(school, pupil):
    pupil.teach(0)
    publish(school, pupil)
    pupil.teach(1)
    pupil.delete("observations/arm/1")
    assert decide(school, pupil) == (True, [pupil.model])
