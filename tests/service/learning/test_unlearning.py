"""Unlearning a batch leaves what the others alone would have taught."""

from __future__ import annotations

from tests.service.learning.lessons import LESSON, apart

EQUAL = 1e-8
"""N·m that two ways to the same knowledge may differ."""


def test_what_is_left_is_what_the_other_batches_teach(school):
    pupil, without = school.enrol("unlearns"), school.enrol("never-learnt")
    pupil.teach(0, 1, 2)
    with_it = pupil.predict()
    said = pupil.delete("observations/arm/1")
    assert said == {
        "model": "unlearns",
        "version": 1,
        "revision": 4,
        "stream_id": "arm",
        "sequence": 1,
        "rows": LESSON,
        "trained": [],
    }
    left = pupil.settled(said["revision"])
    without.teach(0, 2)
    expected = without.predict()
    assert apart(left, expected) < EQUAL
    assert apart(with_it, expected) > 1e3 * EQUAL
    assert pupil.get("observations/arm/1")["state"] == "unlearnt"
    assert pupil.teach(1)["duplicate"] is True  # known, and not learnt by being sent again
    assert apart(pupil.predict(), expected) < EQUAL


def test_all_of_it_leaves_the_version_as_trained(school):
    pupil = school.enrol("unlearns-all")
    trained = pupil.predict()
    pupil.teach(0, 1)
    pupil.delete("observations/arm/0")
    left = pupil.settled(pupil.delete("observations/arm/1")["revision"])
    assert apart(left, trained) < EQUAL


def test_replayed_rows_go_with_their_batch(school):
    pupil, without = school.enrol("unlearns-replayed", contact_threshold=8.0), school.enrol("not-replayed")
    pupil.teach(0, tau=[[50.0, 50.0]] * LESSON)
    pupil.teach(1)
    replayed = pupil.post("observations/arm/0/replay", {"codes": ["contact"]})
    pupil.settled(replayed["revision"])
    said = pupil.delete("observations/arm/0")
    assert said["rows"] == LESSON
    left = pupil.settled(said["revision"])
    without.teach(1)
    assert apart(left, without.predict()) < EQUAL
    assert [replay["state"] for replay in pupil.get("observations/arm/0")["replays"]] == ["unlearnt"]


def test_a_batch_is_unlearnt_once(school):
    pupil = school.enrol("unlearns-once")
    pupil.teach(0)
    pupil.delete("observations/arm/0")
    before = pupil.get("learning")["status"]["events"]
    assert "has been unlearnt" in pupil.refused("DELETE", "observations/arm/0", 409, "conflict")["message"]
    assert pupil.get("learning")["status"]["events"] == before


def test_what_was_rolled_back_cannot_be_unlearnt(school):
    pupil = school.enrol("unlearns-late")
    pupil.teach(0, 1)
    pupil.post("rollback", {"revision": 1})
    assert "rollback" in pupil.refused("DELETE", "observations/arm/1", 409, "conflict")["message"]
    assert pupil.get("observations/arm/1")["state"] == "rolled_back"


def test_versions_that_were_trained_since_are_named(school):
    pupil = school.enrol("trained-since")
    pupil.teach(0)
    school.publish("trained-since")
    school.service.loaded.adopt("trained-since")
    assert pupil.predict()["version"] == 2
    assert pupil.teach(1)["revision"] == 1
    assert pupil.delete("observations/arm/0")["trained"] == [2]
    assert pupil.delete("observations/arm/1")["trained"] == []
