"""Aliases: set, moved, rolled back and removed, and the messages about them."""

import pytest

from service.foundation.errors import NotFoundError
from service.learning.learner.learnt import LearntVersions
from service.models import registry
from service.models.loaded import LoadedModels
from tests.service.data import error, service_of
from tests.service.models.versions import predict, publish


def put(api, model, alias, /, **body):
    return api.put(f"/v1/models/{model}/aliases/{alias}", json=body)


def rollback(api, model, alias):
    return api.post(f"/v1/models/{model}/aliases/{alias}/rollback")


def listed(api, model):
    answer = api.get(f"/v1/models/{model}/aliases").json()
    assert answer["next_cursor"] is None
    return {item["alias"]: item for item in answer["items"]}


def pointers(api, model):
    return {alias: item["version"] for alias, item in listed(api, model).items()}


def test_alias_is_set_moved_and_removed(api, arm):
    made = put(api, arm, "production", version=1)
    assert made.status_code == 200
    assert (made.json()["alias"], made.json()["version"], made.json()["previous"]) == ("production", 1, None)
    assert put(api, arm, "production", version=1).json() == made.json()  # the alias is there already
    moved = put(api, arm, "production", version=2).json()
    assert (moved["version"], moved["previous"]) == (2, 1)
    assert [(move["before"], move["version"]) for move in moved["history"]] == [(1, 2), (None, 1)]
    assert pointers(api, arm) == {"serving": 3, "production": 2}
    assert api.get(f"/v1/models/{arm}").json()["aliases"] == {"production": 2}
    assert api.delete(f"/v1/models/{arm}/aliases/production").status_code == 204
    assert pointers(api, arm) == {"serving": 3}
    error(api.delete(f"/v1/models/{arm}/aliases/production"), 404, "not_found")
    error(predict(api, arm, alias="production"), 404, "not_found")


def test_alias_can_be_set_to_another_alias(api, arm):
    put(api, arm, "candidate", version=2)
    assert put(api, arm, "production", alias="candidate").json()["version"] == 2
    assert put(api, arm, "serving", alias="candidate").json()["version"] == 2
    put(api, arm, "candidate", version=3)
    assert pointers(api, arm) == {"serving": 2, "candidate": 3, "production": 2}


def test_rollbacks_undo_one_move_at_a_time(api, arm):
    for version in (1, 2, 3):
        put(api, arm, "production", version=version)
    back = rollback(api, arm, "production").json()
    assert (back["version"], back["previous"], back["history"][0]["rollback"]) == (2, 1, True)
    assert put(api, arm, "production", version=3).json()["previous"] == 2
    assert [rollback(api, arm, "production").json()["version"] for _ in range(2)] == [2, 1]
    assert "no version before version 1" in error(rollback(api, arm, "production"), 409, "conflict")["message"]
    assert predict(api, arm, alias="production").json()["version"] == 1
    error(rollback(api, arm, "never-was"), 404, "not_found")


def test_rollback_restores_a_removed_alias_but_no_deleted_version(api, arm):
    put(api, arm, "production", version=1)
    put(api, arm, "production", version=2)
    api.delete(f"/v1/models/{arm}/aliases/production")
    assert rollback(api, arm, "production").json()["version"] == 2
    assert predict(api, arm, alias="production").json()["version"] == 2
    assert api.delete(f"/v1/models/{arm}/versions/1").status_code == 204
    assert "version 1, to which" in error(rollback(api, arm, "production"), 409, "conflict")["message"]
    assert pointers(api, arm)["production"] == 2


def test_serving_alias_is_moved_by_training_and_owner(api, arm):
    moves = listed(api, arm)["serving"]["history"]
    assert [(each["before"], each["version"]) for each in moves] == [(2, 3), (1, 2), (None, 1)]
    assert put(api, arm, "serving", version=1).json()["version"] == 1
    assert predict(api, arm).json()["version"] == 1
    assert rollback(api, arm, "serving").json()["version"] == 3
    assert rollback(api, arm, "serving").json()["version"] == 2
    assert predict(api, arm).json()["version"] == predict(api, arm, alias="serving").json()["version"] == 2
    assert api.get(f"/v1/models/{arm}").json()["serving_version"] == 2
    assert "built in" in error(api.delete(f"/v1/models/{arm}/aliases/serving"), 409, "conflict")["message"]


def test_number_of_aliases_is_limited(api, arm, monkeypatch):
    monkeypatch.setattr(registry, "MAX_ALIASES", 2)
    put(api, arm, "one", version=1)
    put(api, arm, "two", version=1)
    assert "2 aliases, the max" in error(put(api, arm, "three", version=1), 409, "conflict")["message"]
    assert put(api, arm, "two", version=2).status_code == 200
    api.delete(f"/v1/models/{arm}/aliases/one")
    assert put(api, arm, "three", version=1).status_code == 200


@pytest.mark.own_files("damages the files below the home, where others lie in the store")
def test_alias_to_an_unreadable_version_is_rejected(api, arm):
    put(api, arm, "production", version=1)
    service = service_of(api)
    publish(api, arm, candidate=True)
    folder = service.files.versions / registry.find(service.database, arm, 4).folder
    (folder / "model.safetensors").write_bytes(b"")
    error(put(api, arm, "production", version=4), 500, "unreadable_version")
    error(put(api, arm, "serving", version=4), 500, "unreadable_version")
    assert pointers(api, arm) == {"serving": 3, "production": 1}
    assert predict(api, arm, alias="production").json()["version"] == 1


def test_aliases_survive_a_restart(api, arm):
    put(api, arm, "production", version=2)
    put(api, arm, "production", version=1)
    put(api, arm, "gone", version=1)
    api.delete(f"/v1/models/{arm}/aliases/gone")
    service = service_of(api)
    started = LoadedModels(service.storage, LearntVersions(service.database, service.files), capacity=2)
    assert started.get(arm, None, "production").version == 1
    with pytest.raises(NotFoundError, match="no alias 'gone'"):
        started.get(arm, None, "gone")
