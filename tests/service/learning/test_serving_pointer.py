"""Which version answers where none is named: the newest, a promoted one, an older one that was chosen."""

from __future__ import annotations

import numpy as np
import pytest
from sqlalchemy import delete

from service.app import create_app
from service.foundation.errors import NotFoundError
from service.learning.learner.learnt import LearntVersions
from service.models import registry
from service.models.loaded import LoadedModels
from service.models.registry import Serving
from service.storage.database import LearnerRow, ServingRow
from tests.service.data import ADDRESS
from tests.service.learning.pendulums import ARM

QUERY = {"q": [0.1, 0.2], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}


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


def earlier_release(arm):
    """Make the home one of a release that knew neither candidates nor learning."""
    with arm.database.transaction() as session:
        session.execute(delete(ServingRow))
        session.execute(delete(LearnerRow))


def test_a_trained_version_serves_and_the_one_before_learns_no_more(arm):
    assert serving(arm) == Serving(1, 1)
    arm.batches(0, 1, 2)
    assert arm.publish() == 2
    assert serving(arm) == Serving(2, 2)
    assert roles(arm) == {1: (0, "dismissed"), 2: (3, "serving")}


def test_a_candidate_does_not_serve_until_it_is_promoted(arm):
    arm.batches(0, 1, 2)
    assert arm.publish(candidate=True, start=1) == 2
    assert serving(arm) == Serving(1, 1)
    assert roles(arm) == {1: (0, "serving"), 2: (1, "candidate")}
    assert registry.find(arm.database, ARM, None).version == 1
    shown = registry.show(arm.database, ARM)
    assert (shown.latest_version, shown.serving_version) == (2, 1)
    assert serve(arm, 2) == 2
    assert roles(arm) == {1: (0, "dismissed"), 2: (1, "serving")}
    assert registry.find(arm.database, ARM, None).version == 2
    assert registry.show(arm.database, ARM).serving_version == 2


def test_an_older_version_can_be_chosen_again_and_learns_again(arm):
    arm.publish()
    assert serve(arm, 1) == 3
    assert serving(arm) == Serving(1, 3)
    assert roles(arm) == {1: (0, "serving"), 2: (0, "dismissed")}
    assert arm.publish() == 3
    assert serving(arm) == Serving(3, 4)


def test_choosing_what_serves_changes_nothing(arm):
    assert serve(arm, 1) == 1
    assert serving(arm) == Serving(1, 1)


def test_a_version_that_is_not_there_cannot_be_chosen(arm):
    with pytest.raises(NotFoundError, match="no version '7'"):
        serve(arm, 7)
    assert serving(arm) == Serving(1, 1)


def test_the_first_version_serves_though_it_was_meant_as_a_candidate(arm):
    arm.publish("fresh", candidate=True)
    assert registry.serving(arm.database, ["fresh"]) == {"fresh": Serving(1, 1)}


def test_a_home_of_an_earlier_release_is_served_by_its_newest_versions(arm):
    arm.publish()
    earlier_release(arm)
    assert serving(arm) == Serving(2, 0)
    assert registry.find(arm.database, ARM, None).version == 2
    assert registry.show(arm.database, ARM).serving_version == 2
    arm.publish(candidate=True)
    assert serving(arm) == Serving(2, 1)
    assert serve(arm, 3) == 2


def test_models_without_a_version_have_none_that_serves(arm):
    assert registry.serving(arm.database, ["nobody"]) == {}
    assert registry.serving(arm.database, []) == {}


def test_the_models_that_changed_last_are_loaded_first(arm):
    arm.publish("other")
    arm.publish(candidate=True)
    assert registry.recent(arm.database, 1) == [ARM]
    assert set(registry.recent(arm.database, 5)) == {ARM, "other"}
    loaded = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    assert loaded.preload() == 2
    assert loaded.hot(ARM, None).version == 1


# in memory


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


def test_a_version_asked_for_by_number_does_not_become_the_one_that_serves(arm, loaded):
    loaded.get(ARM, None)
    arm.publish(candidate=True)
    assert loaded.get(ARM, 2).version == 2
    assert loaded.hot(ARM, None).version == 1


def test_a_model_without_an_answer_yet_is_not_loaded_by_an_announcement(arm, loaded):
    loaded.announce([ARM])
    assert loaded.hot(ARM, None) is None
    assert loaded.newest(ARM) is None


def test_a_version_that_cannot_be_read_leaves_the_one_before_answering(arm, loaded, caplog):
    loaded.get(ARM, None)
    arm.publish()
    (arm.files.versions / registry.find(arm.database, ARM, 2).folder / "model.safetensors").write_bytes(b"")
    loaded.adopt(ARM)
    assert loaded.hot(ARM, None).version == 1
    assert "version 2 of model 'arm' cannot be loaded" in caplog.text


def test_the_service_answers_from_the_version_that_serves(arm):
    from fastapi.testclient import TestClient

    arm.publish(candidate=True)
    with TestClient(create_app(arm.settings), ADDRESS) as api:
        shown = api.get(f"/v1/models/{ARM}").json()
        assert (shown["latest_version"], shown["serving_version"]) == (2, 1)
        assert api.post(f"/v1/models/{ARM}/predict", json=QUERY).json()["version"] == 1
        serve(arm, 2)
        assert api.get("/v1/models").json()["items"][0]["serving_version"] in (1, 2)
        found = api.post(f"/v1/models/{ARM}/predict", json=QUERY).json()
        assert found["version"] == 2
        assert np.isfinite(found["tau"]).all()
