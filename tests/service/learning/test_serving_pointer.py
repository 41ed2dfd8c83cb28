"""Which version answers where none is named: the newest, a promoted one, an older one; and what a verdict leads to."""

import pytest
from sqlalchemy import select

from service.contract.models import Promotion
from service.foundation.errors import NoServingVersionError, NotFoundError
from service.learning.learner.learnt import LearntVersions
from service.models import deletion, registry
from service.models.loaded import LoadedModels
from service.models.registry import Serving
from service.storage.database import JobRow, LearnerRow, VersionRow, now
from service.training import refreshed
from tests.service.learning.lessons import answered
from tests.service.learning.pendulums import ARM


@pytest.fixture
def loaded(arm):
    """What a service has in memory."""
    return LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=4)


def serving(arm):
    return registry.serving(arm.database, [ARM])[ARM]


def serve(arm, version):
    with arm.database.transaction() as session:
        return registry.serve(session, ARM, version)


def roles(arm):
    with arm.database.session() as session:
        rows = [session.get(LearnerRow, (ARM, version)) for version in range(1, 10)]
    return {row.version: (row.start, row.role) for row in rows if row is not None}


def test_a_candidate_does_not_serve_until_it_is_promoted(arm):
    arm.batches(0, 1, 2)
    assert arm.publish(candidate=True, start=1) == 2
    assert serving(arm) == Serving(1, 1)
    assert roles(arm) == {1: (0, "serving"), 2: (1, "dismissed")}
    assert registry.find(arm.database, ARM, None).version == 1
    shown = registry.show(arm.database, ARM)
    assert (shown.latest_version, shown.serving_version) == (2, 1)
    assert serve(arm, 2) == 2
    assert roles(arm) == {1: (0, "dismissed"), 2: (1, "serving")}
    assert registry.find(arm.database, ARM, None).version == 2
    assert registry.show(arm.database, ARM).serving_version == 2


def test_a_first_version_that_is_a_candidate_does_not_serve(arm):
    arm.publish("fresh", candidate=True)
    assert registry.serving(arm.database, ["fresh"]) == {}
    with pytest.raises(NoServingVersionError, match="`lipserve models promote fresh 1`"):
        registry.find(arm.database, "fresh", None)
    assert registry.show(arm.database, "fresh").serving_version is None


def test_what_serves_or_is_not_there_cannot_be_chosen(arm):
    assert serve(arm, 1) == 1
    with pytest.raises(NotFoundError, match="no version '7'"):
        serve(arm, 7)
    assert serving(arm) == Serving(1, 1)


def test_the_models_that_changed_last_are_loaded_first(arm):
    arm.publish("other")
    arm.publish(candidate=True)
    assert registry.recent(arm.database, 1) == [ARM]
    assert set(registry.recent(arm.database, 5)) == {ARM, "other"}
    loaded = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    assert loaded.preload() == 2
    assert loaded.hot(ARM, None).version == 1


def test_a_version_that_cannot_be_read_leaves_the_one_before_answering(arm, loaded, caplog):
    loaded.get(ARM, None)
    arm.publish()
    (arm.files.versions / registry.find(arm.database, ARM, 2).folder / "model.safetensors").write_bytes(b"")
    loaded.adopt(ARM)
    assert loaded.hot(ARM, None).version == 1
    assert "version 2 of model 'arm' cannot be loaded" in caplog.text


def test_answers_follow_the_version_that_serves_forwards_and_back(arm, loaded):
    assert loaded.get(ARM, None).version == 1
    arm.publish(candidate=True)
    loaded.announce([ARM])
    loaded.adopt(ARM)
    assert (loaded.hot(ARM, None).version, loaded.newest(ARM)) == (1, 1)
    serve(arm, 2)
    assert loaded.hot(ARM, None).version == 1
    loaded.announce([ARM, "nobody"])
    assert (loaded.hot(ARM, None).version, loaded.newest(ARM)) == (2, 2)
    serve(arm, 1)
    loaded.adopt(ARM)
    assert (loaded.hot(ARM, None).version, loaded.newest(ARM)) == (1, 1)


def test_a_decision_that_is_heard_of_late_does_not_undo_a_later_one(arm, loaded):
    arm.publish()
    serve(arm, 1)
    assert loaded.get(ARM, None).version == 1
    loaded._load(registry.find(arm.database, ARM, 2), Serving(2, 2))
    assert loaded.hot(ARM, None).version == 1


EVIDENCE = {"rows": 700, "gain": 0.5, "standard_error": 0.1}


def decide(school, pupil, version=2, better=True, serving=1):
    """What the job of a refresh does with the version that it has added, and the service then; in words."""
    service, reason = school.service, f"it predicts the newest logged rows {'' if better else 'no '}better"
    judged = Promotion(answers=better, passed=better, serving=serving, reason=reason)
    with service.database.transaction() as session:
        outcome = refreshed.promote(session, pupil.model, version, judged, EVIDENCE)
    service.loaded.changed(pupil.model)
    deletion.delete_refreshed(service.loaded, pupil.model)
    return outcome


def roles_of(school, pupil):
    """Role of each version."""
    with school.service.database.session() as session:
        rows = session.scalars(select(LearnerRow).where(LearnerRow.model == pupil.model))
        return {row.version: row.role for row in rows}


def answering(pupil):
    """Which version is said to answer, and which one does."""
    said = answered(pupil.client.get(f"/v1/models/{pupil.model}"))["serving_version"]
    return said, pupil.predict()["version"]


def test_a_better_candidate_answers_and_learns_from_then_on(school, pupil):
    assert answering(pupil) == (1, 1)
    school.publish(pupil.model, candidate=True)
    assert answering(pupil) == (1, 1)
    assert decide(school, pupil).startswith("answers from now on: it predicts")
    assert school.service.loaded.hot(pupil.model, None).version == 2
    assert answering(pupil) == (2, 2)
    assert roles_of(school, pupil) == {1: "dismissed", 2: "serving"}
    [alarm] = pupil.get("alarms")["items"]
    assert alarm["kind"] == "promotion"
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": True, **EVIDENCE}
    line = audited(pupil)
    assert (line["change"], line["alias"], line["what"]) == ("alias moved", "serving", "service")
    assert (line["before"], line["after"]) == (1, 2)


def audited(pupil):
    """The newest line of the audit log on a model."""
    return answered(pupil.client.get("/v1/audit", params={"model": pupil.model}))["items"][0]


def test_one_that_is_not_better_is_dismissed_for_good(school, pupil):
    school.publish(pupil.model, candidate=True)
    assert decide(school, pupil, better=False).startswith("is dismissed: it predicts")
    assert answering(pupil) == (1, 1)
    assert roles_of(school, pupil) == {1: "serving", 2: "dismissed"}
    [alarm] = pupil.get("alarms")["items"]
    assert (alarm["evidence"]["verdict"], alarm["evidence"]["promoted"]) == ("dismiss", False)
    line = audited(pupil)
    assert (line["change"], line["version"], line["what"]) == ("candidate dismissed", 2, "service")
    assert line["after"] == {"verdict": "dismiss", "serving": 1}


def test_of_versions_that_refreshed_themselves_the_newest_are_kept_and_those_that_are_needed(
    school, pupil, monkeypatch
):
    monkeypatch.setattr("service.models.deletion.MAX_REFRESHED", 1)

    def end(version, trigger, better):
        """The end of a refresh."""
        school.publish(pupil.model, candidate=True)
        job = f"job_{pupil.model[-20:]}_{version}"
        with school.service.database.transaction() as session:
            request = {"refresh": {"version": 1, "trigger": trigger}}
            session.add(
                JobRow(id=job, model=pupil.model, state="succeeded", request=request, progress={}, created_at=now())
            )
            session.get_one(VersionRow, (pupil.model, version)).job = job
        decide(school, pupil, version, better, answering(pupil)[0])

    end(2, "novelty", True)
    end(3, "asked", True)  # a rollback returns to 2
    end(4, "linearisation", False)
    answered(pupil.client.put(f"/v1/models/{pupil.model}/aliases/liked", json={"version": 4}))
    end(5, "novelty", False)
    assert versions_of(pupil) == [1, 2, 3, 4, 5]
    end(6, "novelty", False)
    assert versions_of(pupil) == [1, 2, 3, 4, 6]
    lines = answered(pupil.client.get("/v1/audit", params={"model": pupil.model}))["items"]
    assert [line["version"] for line in lines if line["change"] == "version deleted"] == [5]
    assert answering(pupil) == (3, 3)


def versions_of(pupil):
    """The versions that there are."""
    return [each["version"] for each in answered(pupil.client.get(f"/v1/models/{pupil.model}"))["versions"]]


def test_the_owner_may_decide_alone(school, pupil):
    pupil.put("learning", {"auto_promote": False})
    school.publish(pupil.model, candidate=True)
    assert decide(school, pupil).startswith("waits")
    assert answering(pupil) == (1, 1)
    [alarm] = pupil.get("alarms")["items"]
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": False, **EVIDENCE}
    assert "rollback to version 2" in alarm["message"]
    pupil.post("rollback", {"version": 2})
    assert answering(pupil) == (2, 2)


def test_one_that_was_compared_with_a_version_that_serves_no_more_waits(school, pupil):
    school.publish(pupil.model, candidate=True)
    school.publish(pupil.model)
    assert decide(school, pupil).startswith("waits")
    assert answering(pupil) == (3, 3)
