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


def read_roles(database, model=ARM):
    """Return the first event and the role of each version."""
    with database.session() as session:
        rows = session.scalars(select(LearnerRow).where(LearnerRow.model == model))
        return {row.version: (row.start, row.role) for row in rows}


def test_candidate_does_not_serve_until_promoted(arm):
    arm.log_batches(0, 1, 2)
    assert arm.publish(candidate=True, start=1) == 2
    assert read_serving(arm) == Serving(1, 1)
    assert read_roles(arm.database) == {1: (0, "serving"), 2: (1, "dismissed")}
    assert registry.find(arm.database, ARM, None).version == 1
    shown = registry.show(arm.database, ARM)
    assert (shown.latest_version, shown.serving_version) == (2, 1)
    assert serve_version(arm, 2) == 2
    assert read_roles(arm.database) == {1: (0, "dismissed"), 2: (1, "serving")}
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
    def read_versions():
        return loaded_models.hot(ARM, None).version, loaded_models.newest(ARM)

    assert loaded_models.get(ARM, None).version == 1
    arm.publish(candidate=True)
    loaded_models.announce([ARM])
    loaded_models.adopt(ARM)
    assert read_versions() == (1, 1)
    serve_version(arm, 2)
    assert loaded_models.hot(ARM, None).version == 1
    loaded_models.announce([ARM, "nobody"])
    assert read_versions() == (2, 2)
    serve_version(arm, 1)
    loaded_models.adopt(ARM)
    assert read_versions() == (1, 1)


def test_late_notice_does_not_undo_a_later_decision(arm, loaded_models):
    arm.publish()
    serve_version(arm, 1)
    assert loaded_models.get(ARM, None).version == 1
    loaded_models._load(registry.find(arm.database, ARM, 2), Serving(2, 2))
    assert loaded_models.hot(ARM, None).version == 1


EVIDENCE = {"rows": 700, "gain": 0.5, "standard_error": 0.1}


def decide_refresh(learning_service, learning_model, version=2, better=True, serving=1):
    """Judge a refreshed version as its job and the service do; return the outcome in words."""
    service, reason = learning_service.service, f"It predicts the newest logged rows {'' if better else 'no '}better."
    promotion = Promotion(answers=better, serving=serving, reason=reason)
    with service.database.transaction() as session:
        outcome = refreshed.promote(session, learning_model.name, version, promotion, EVIDENCE)
    service.loaded.changed(learning_model.name)
    deletion.delete_refreshed(service.loaded, learning_model.name)
    return outcome


def read_serving_versions(learning_model):
    """Return the serving version as shown, and the version that predicts."""
    reply = read_json(learning_model.client.get(f"/v1/models/{learning_model.name}"))["serving_version"]
    return reply, learning_model.predict()["version"]


@pytest.mark.parametrize("better", [True, False], ids=["better", "no better"])
def test_candidate_serves_and_learns_if_better(learning_service, learning_model, better):
    assert read_serving_versions(learning_model) == (1, 1)
    learning_service.publish(learning_model.name, candidate=True)
    assert read_serving_versions(learning_model) == (1, 1)
    outcome = decide_refresh(learning_service, learning_model, better=better)
    assert outcome.startswith("is now serving: It predicts" if better else "is dismissed: It predicts")
    serving, dismissed = (2, 1) if better else (1, 2)
    assert learning_service.service.loaded.hot(learning_model.name, None).version == serving
    assert read_serving_versions(learning_model) == (serving, serving)
    roles = read_roles(learning_service.service.database, learning_model.name)
    assert roles == {serving: (0, "serving"), dismissed: (0, "dismissed")}
    [alarm] = learning_model.get("alarms")["items"]
    assert alarm["kind"] == "promotion"
    verdict = {"verdict": "promote" if better else "dismiss", "promoted": better}
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, **verdict, **EVIDENCE}
    line = read_json(learning_model.client.get("/v1/audit", params={"model": learning_model.name}))["items"][0]
    if better:
        expected = {"change": "alias moved", "alias": "serving", "before": 1, "after": 2}
    else:
        expected = {"change": "candidate dismissed", "version": 2, "after": {"verdict": "dismiss", "serving": 1}}
    assert line.items() >= {"what": "service", **expected}.items()


def test_old_automatic_versions_are_deleted_unless_needed(learning_service, learning_model, monkeypatch):
    monkeypatch.setattr("service.models.deletion.MAX_REFRESHED", 1)

    name, client = learning_model.name, learning_model.client

    def end_refresh(version, trigger, better):
        """Publish and judge the version of a refresh job."""
        learning_service.publish(name, candidate=True)
        job, request = f"job_{name[-20:]}_{version}", {"refresh": {"version": 1, "trigger": trigger}}
        with learning_service.service.database.transaction() as session:
            session.add(JobRow(id=job, model=name, state="succeeded", request=request, progress={}, created_at=now()))
            session.get_one(VersionRow, (name, version)).job = job
        decide_refresh(learning_service, learning_model, version, better, read_serving_versions(learning_model)[0])

    def list_versions():
        return [each["version"] for each in read_json(client.get(f"/v1/models/{name}"))["versions"]]

    end_refresh(2, "novelty", True)
    end_refresh(3, "asked", True)  # 2 is kept as the target of a rollback
    end_refresh(4, "linearisation", False)
    learning_model.put("aliases/liked", {"version": 4, "override": True})
    end_refresh(5, "novelty", False)
    assert list_versions() == [1, 2, 3, 4, 5]
    end_refresh(6, "novelty", False)
    assert list_versions() == [1, 2, 3, 4, 6]
    lines = read_json(client.get("/v1/audit", params={"model": name}))["items"]
    assert [line["version"] for line in lines if line["change"] == "version deleted"] == [5]
    assert read_serving_versions(learning_model) == (3, 3)


def test_candidate_waits_without_auto_promote(learning_service, learning_model):
    learning_model.put("learning", {"auto_promote": False})
    learning_service.publish(learning_model.name, candidate=True)
    assert decide_refresh(learning_service, learning_model).startswith("is a candidate")
    assert read_serving_versions(learning_model) == (1, 1)
    [alarm] = learning_model.get("alarms")["items"]
    assert alarm["evidence"] == {"serving": 1, "candidate": 2, "verdict": "promote", "promoted": False, **EVIDENCE}
    assert "Roll back to version 2" in alarm["message"]
    learning_model.post("rollback", {"version": 2})
    assert read_serving_versions(learning_model) == (2, 2)


def test_candidate_compared_with_retired_version_waits(learning_service, learning_model):
    learning_service.publish(learning_model.name, candidate=True)
    learning_service.publish(learning_model.name)
    assert decide_refresh(learning_service, learning_model).startswith("is a candidate")
    assert read_serving_versions(learning_model) == (3, 3)
