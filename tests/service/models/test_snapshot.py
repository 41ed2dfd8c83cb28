"""Snapshots of what answers: which version an alias names, which revision stays, what is dropped and deleted."""

from dataclasses import replace

import numpy as np
import pytest

from service.learning.learner.learnt import LearntVersions
from service.models.changes import Changes
from service.models.loaded import LoadedModels
from service.models.loads import StreamPayload, StreamPayloads
from service.models.registry import Serving
from service.models.scales import Factor, Scales
from service.models.served import ServedModel
from service.models.snapshot import Snapshot
from tests.service.learning.pendulums import ARM, Arm, trained_model


def served(version, revision=0, name="arm"):
    """Return a version."""
    model = trained_model()
    return ServedModel(name, version, model, model, frozenset(), Scales(model.scale), StreamPayloads(), revision)


def test_versions_are_found_by_number_alias_and_service():
    one, two = served(1), served(2)
    known = Snapshot().with_version(one).with_version(two).with_serving("arm", Serving(2, 1)).with_alias("arm", "a", 1)
    cases = [((1, None), one), ((1, "a"), one), ((None, None), two), ((None, "serving"), two), ((None, "a"), one)]
    cases += [((3, None), None), ((None, "b"), None)]
    for (version, alias), expected in cases:
        assert known.find("arm", version, alias) is expected
    assert known.find("other", None) is None
    assert known.versions_of("arm") == {1: one, 2: two}
    assert known.pointed("arm", "a") == 1
    assert known.with_alias("arm", "a", None).pointed("arm", "a") is None
    assert Snapshot().find("arm", 1) is None


def test_only_higher_revisions_and_later_changes_replace():
    old, new = served(1, 3), served(1, 4)
    known = Snapshot().with_version(old)
    assert known.with_version(served(1, 3)) is known
    assert known.with_version(new).served["arm", 1] is new
    assert known.with_version(new).with_version(old).served["arm", 1] is new
    known = known.with_serving("arm", Serving(2, 5))
    assert known.with_serving("arm", Serving(1, 4)) is known
    assert known.with_serving("arm", Serving(1, 6)).pointed("arm", None) == 1


def test_dropped_versions_keep_their_aliases_and_deleted_models_lose_them():
    known = Snapshot().with_version(served(1)).with_version(served(2)).with_serving("arm", Serving(2, 1))
    known = known.with_alias("arm", "a", 1).with_alias("other", "a", 1)
    assert known.without(()) is known
    dropped = known.without([("arm", 2)])
    assert (dropped.pointed("arm", None), dropped.find("arm", None)) == (2, None)
    assert not dropped.deleted
    gone = known.without_deleted([("arm", 1)])
    assert (gone.deleted, gone.pointed("arm", "a"), set(gone.served)) == ({("arm", 1)}, 1, {("arm", 2)})
    gone = gone.without_deleted([("arm", 2)], "arm")
    assert (gone.deleted, gone.served, gone.serving) == ({("arm", 1), ("arm", 2)}, {}, {})
    assert gone.aliases == {("other", "a"): 1}
    replaced = known.with_aliases({("arm", "b"): 2}, ["arm"])
    assert replaced.aliases == {("arm", "b"): 2, ("other", "a"): 1}
    assert known.with_aliases({("arm", "b"): 2}, None).aliases == {("arm", "b"): 2}


def test_replaced_factors_and_payloads_are_changes():
    changes, model = Changes(), trained_model()
    scales, payloads = Scales(model.scale, changes.note), StreamPayloads(changes.note)
    factor = Factor(np.full(2, 1.5), np.full(2, 1.2), 10.0)
    scales.replace({"a": factor})
    assert changes.number == 1
    assert scales.streams() == {"a": factor}
    known = {"a": StreamPayload(model, (1.0, 0.1), 3.0), "": StreamPayload(None, None, 2.0)}
    payloads.replace(known)
    assert changes.number == 2
    assert payloads.streams() == known
    again = StreamPayloads()
    again.replace(payloads.streams())
    assert again.default_model is payloads.default_model is model
    assert again.mass(None) is None


def test_waiting_thread_sees_each_change_once():
    changes = Changes()
    assert changes.wait(0, 0.0) == 0
    changes.note()
    changes.note()
    assert changes.wait(0) == 2  # at once
    assert changes.wait(2, 0.0) == 2


@pytest.fixture
def loaded(tmp_path):
    """Loaded models of a service with one version."""
    arm = Arm.open(tmp_path / "home")
    found = LoadedModels(arm.storage, LearntVersions(arm.database, arm.files), capacity=2)
    found.get(ARM, None)
    yield found
    arm.database.close()


def test_loaded_models_count_their_changes(loaded):
    seen = loaded.changes.number
    steps = [
        lambda: loaded.point("arm", "a", 1),
        lambda: loaded.repoint({("arm", "b"): 1}, None),
        lambda: loaded.get("arm", None).scales.replace({}),
        lambda: loaded.get("arm", None).payloads.replace({}),
        lambda: loaded._publish(replace(loaded.get("arm", None), revision=9)),
        lambda: loaded.forget("arm", [1], entirely=True),
    ]
    for step in steps:
        step()
        assert loaded.changes.number > seen
        seen = loaded.changes.number
    assert loaded.is_deleted("arm", 1)
    assert loaded.hot("arm", None) is None
    assert loaded.changes.number == seen  # reading changes nothing
