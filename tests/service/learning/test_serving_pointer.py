"""The serving version: publication, promotion, rollback, and the verdict on a refreshed candidate."""

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
from tests.service.learning.learning_models import read_json
from tests.service.learning.pendulums import ARM


@pytest.fixture
def loaded_models(arm):
    """Loaded models of a service."""
    return LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=4)


def read_serving(arm):
    return registry.serving(arm.database, [ARM])[ARM]


def serve_version(arm, version):
    with arm.database.transaction() as session:
        return registry.serve(session, ARM, version)


def read_roles(arm):
    with arm.database.session() as session:
        rows = [session.get(LearnerRow, (ARM, version)) for version in range(1, 10)]
    return {row.version: (row.start, row.role) for row in rows if row is not None}


def test_candidate_does_not_serve_until_promoted(arm):
    arm.log_batches(0, 1, 2)
    assert arm.publish(candidate=True, start=1) == 2
    assert read_serving(arm) == Serving(1, 1)
    assert read_roles(arm) == {1: (0, "serving"), 2: (1, "dismissed")}
    assert registry.find(arm.database, ARM, None).version == 1
    shown = registry.show(arm.database, ARM)
    assert (shown.latest_version, shown.serving_version) == (2, 1)
    assert serve_version(arm, 2) == 2
    assert read_roles(arm) == {1: (0, "dismissed"), 2: (1, "serving")}
    assert registry.find(arm.database, ARM, None).version == 2
    assert registry.show(arm.database, ARM).serving_version == 2


def test_first_version_can_be_a_candidate(arm):
    arm.publish("fresh", candidate=True)
    assert registry.serving(arm.database, ["fresh"]) == {}
    with pytest.raises(NoServingVersionError, match="`lipserve models promote fresh 1`"):
        registry.find(arm.database, "fresh", None)
    assert registry.show(arm.database, "fresh").serving_version is None


def test_unknown_version_cannot_serve(arm):
    assert serve_version(arm, 1) == 1
    with pytest.raises(NotFoundError, match="no version '7'"):
        serve_version(arm, 7)
    assert read_serving(arm) == Serving(1, 1)


def test_preload_starts_with_the_newest_models(arm):
    arm.publish("other")
    arm.publish(candidate=True)
    assert registry.recent(arm.database, 1) == [ARM]
    assert set(registry.recent(arm.database, 5)) == {ARM, "other"}
    loaded_models = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    assert loaded_models.preload() == 2
    assert loaded_models.hot(ARM, None).version == 1


def test_unreadable_version_leaves_previous_one_serving(arm, loaded_models, caplog):
    loaded_models.get(ARM, None)
    arm.publish()
    (arm.files.versions / registry.find(arm.database, ARM, 2).folder / "model.safetensors").write_bytes(b"")
    loaded_models.adopt(ARM)
    assert loaded_models.hot(ARM, None).version == 1
    assert "version 2 of model 'arm' cannot be loaded" in caplog.text


def test_predictions_follow_the_serving_version_both_ways(arm, loaded_models):
    assert loaded_models.get(ARM, None).version == 1
    arm.publish(candidate=True)
    loaded_models.announce([ARM])
    loaded_models.adopt(ARM)
    assert (loaded_models.hot(ARM, None).version, loaded_models.newest(ARM)) == (1, 1)
    serve_version(arm, 2)
    assert loaded_models.hot(ARM, None).version == 1
    loaded_models.announce([ARM, "nobody"])
    assert (loaded_models.hot(ARM, None).version, loaded_models.newest(ARM)) == (2, 2)
    serve_version(arm, 1)
    loaded_models.adopt(ARM)
    assert (loaded_models.hot(ARM, None).version, loaded_models.newest(ARM)) == (1, 1)


def test_late_notice_does_not_undo_a_later_decision(arm, loaded_models):
    arm.publish()
    serve_version(arm, 1)
    assert loaded_models.get(ARM, None).version == 1
    loaded_models._load(registry.find(arm.database, ARM, 2), Serving(2, 2))
    assert loaded_models.hot(ARM, None).version == 1


EVIDENCE = {"rows": 700, "gain": 0.5, "standard_error": 0.1}


def decide_refresh(learning_service, learning_model, version=2, better=True, serving=1):
    """Judge a refreshed version as its job and the service do; return the outcome in words."""
    service, reason = learning_service.service, f"it predicts the newest logged rows {'' if better else 'no '}better"
    promotion = Promotion(answers=better, passed=better, serving=serving, reason=reason)
    with service.database.transaction() as session:
        outcome = refreshed.promote(session, learning_model.name, version, promotion, EVIDENCE)
    service.loaded.changed(learning_model.name)
    deletion.delete_refreshed(service.loaded, learning_model.name)
    return outcome


def list_roles(learning_service, learning_model):
    """Return the role of each version."""
    with learning_service.service.database.session() as session:
        rows = session.scalars(select(LearnerRow).where(LearnerRow.model == learning_model.name))
        return {row.version: row.role for row in rows}


def read_serving_versions(learning_model):
    """Return the serving version as shown, and the version that predicts."""
    reply = read_json(learning_model.client.get(f"/v1/models/{learning_model.name}"))["serving_version"]
    return reply, learning_model.predict()["version"]


def test_better_candidate_serves_and_learns(learning_service, learning_model):
    assert read_serving_versions(learning_model) == (1, 1)
    learning_service.publish(learning_model.name, candidate=True)
    assert read_serving_versions(learning_model) == (1, 1)
    assert decide_refresh(learning_service, learning_model).startswith("is now serving: it predicts")
    assert learning_service.service.loaded.hot(learning_model.name, None).version == 2
    assert read_serving_versions(learning_model) == (2, 2)
    assert list_roles(learning_service, learning_model) == {1: "dismissed", 2: "serving"}
    [alarm] = learning_model.get("alarms")["items"]
    assert alarm["kind"] == "promotion"
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": True, **EVIDENCE}
    line = read_newest_audit_line(learning_model)
    assert (line["change"], line["alias"], line["what"]) == ("alias moved", "serving", "service")
    assert (line["before"], line["after"]) == (1, 2)


def read_newest_audit_line(learning_model):
    """Return the newest line of the audit log of a model."""
    return read_json(learning_model.client.get("/v1/audit", params={"model": learning_model.name}))["items"][0]


def test_candidate_that_is_not_better_is_dismissed(learning_service, learning_model):
    learning_service.publish(learning_model.name, candidate=True)
    assert decide_refresh(learning_service, learning_model, better=False).startswith("is dismissed: it predicts")
    assert read_serving_versions(learning_model) == (1, 1)
    assert list_roles(learning_service, learning_model) == {1: "serving", 2: "dismissed"}
    [alarm] = learning_model.get("alarms")["items"]
    assert (alarm["evidence"]["verdict"], alarm["evidence"]["promoted"]) == ("dismiss", False)
    line = read_newest_audit_line(learning_model)
    assert (line["change"], line["version"], line["what"]) == ("candidate dismissed", 2, "service")
    assert line["after"] == {"verdict": "dismiss", "serving": 1}


def test_old_automatic_versions_are_deleted_unless_needed(learning_service, learning_model, monkeypatch):
    monkeypatch.setattr("service.models.deletion.MAX_REFRESHED", 1)

    def end_refresh(version, trigger, better):
        """Publish and judge the version of a refresh job."""
        learning_service.publish(learning_model.name, candidate=True)
        job = f"job_{learning_model.name[-20:]}_{version}"
        with learning_service.service.database.transaction() as session:
            request = {"refresh": {"version": 1, "trigger": trigger}}
            session.add(
                JobRow(
                    id=job, model=learning_model.name, state="succeeded", request=request, progress={}, created_at=now()
                )
            )
            session.get_one(VersionRow, (learning_model.name, version)).job = job
        decide_refresh(learning_service, learning_model, version, better, read_serving_versions(learning_model)[0])

    end_refresh(2, "novelty", True)
    end_refresh(3, "asked", True)  # 2 is kept as the target of a rollback
    end_refresh(4, "linearisation", False)
    read_json(learning_model.client.put(f"/v1/models/{learning_model.name}/aliases/liked", json={"version": 4}))
    end_refresh(5, "novelty", False)
    assert list_versions(learning_model) == [1, 2, 3, 4, 5]
    end_refresh(6, "novelty", False)
    assert list_versions(learning_model) == [1, 2, 3, 4, 6]
    lines = read_json(learning_model.client.get("/v1/audit", params={"model": learning_model.name}))["items"]
    assert [line["version"] for line in lines if line["change"] == "version deleted"] == [5]
    assert read_serving_versions(learning_model) == (3, 3)


def list_versions(learning_model):
    """Return the existing versions."""
    return [
        each["version"]
        for each in read_json(learning_model.client.get(f"/v1/models/{learning_model.name}"))["versions"]
    ]


def test_candidate_waits_without_auto_promote(learning_service, learning_model):
    learning_model.put("learning", {"auto_promote": False})
    learning_service.publish(learning_model.name, candidate=True)
    assert decide_refresh(learning_service, learning_model).startswith("waits")
    assert read_serving_versions(learning_model) == (1, 1)
    [alarm] = learning_model.get("alarms")["items"]
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": False, **EVIDENCE}
    assert "roll back to version 2" in alarm["message"]
    learning_model.post("rollback", {"version": 2})
    assert read_serving_versions(learning_model) == (2, 2)


def test_candidate_compared_with_retired_version_waits(learning_service, learning_model):
    learning_service.publish(learning_model.name, candidate=True)
    learning_service.publish(learning_model.name)
    assert decide_refresh(learning_service, learning_model).startswith("waits")
    assert read_serving_versions(learning_model) == (3, 3)
