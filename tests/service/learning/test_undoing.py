"""One call goes back to an earlier revision or version, takes a batch back, or learns what was kept out after all."""

import numpy as np
import pytest

from service.journal import log, snapshots
from service.learning.control import status
from tests.service.data import error, eventually
from tests.service.learning.batches import MODEL, batch, note, roll_back, write
from tests.service.learning.lessons import LESSON, apart, lesson

EQUAL = 1e-8


def test_answers_are_those_of_then(school):
    pupil = school.enrol("returns")
    then = [pupil.predict()]
    for number in range(4):
        pupil.teach(number)
        then.append(pupil.predict())
    said = pupil.post("rollback", {"revision": 2})
    assert said == {"model": "returns", "version": 1, "revision": 5, "undone": 2, "complete": True}
    assert apart(pupil.settled(5), then[2]) < EQUAL
    assert apart(then[4], then[2]) > 1e3 * EQUAL
    states = [item["state"] for item in pupil.get("observations")["items"]]
    assert states == ["rolled_back", "rolled_back", "learnt", "learnt"]
    said = pupil.post("rollback", {"revision": 0})
    assert said["undone"] == 2
    assert apart(pupil.settled(said["revision"]), then[0]) < EQUAL


def test_only_an_older_revision_is_gone_back_to(school):
    pupil = school.enrol("no-future")
    pupil.teach(0, 1)
    for revision in (2, 3):
        body = pupil.refused("POST", "rollback", 422, "invalid_request", json={"revision": revision})
        assert body["detail"] == [
            {"field": "revision", "value": str(revision), "expected": "one below 2, the newest of version 1"}
        ]


@pytest.mark.parametrize("body", [{}, {"revision": 0, "version": 1}])
def test_exactly_one_goal_is_named(school, body):
    answer = school.client.post("/v1/models/panda-sim/rollback", json=body)
    assert error(answer, 422, "invalid_request")["detail"][0]["field"] == "revision or version"


def test_a_branch_that_was_undone_is_not_returned_to(school):
    pupil = school.enrol("branches")
    pupil.teach(0, 1, 2)
    pupil.settled(pupil.post("rollback", {"revision": 1})["revision"])
    pupil.teach(3)
    assert pupil.get("learning")["status"]["reachable"] == [[0, 1], [4, 5]]
    body = pupil.refused("POST", "rollback", 409, "conflict", json={"revision": 2})
    assert body["detail"] == [{"field": "revision", "value": "2", "expected": "one of 0 to 1, 4 to 5"}]
    at_four = pupil.settled(pupil.post("rollback", {"revision": 4})["revision"])
    other = school.enrol("first-only")
    other.teach(0)
    assert apart(at_four, other.predict()) < EQUAL


def test_where_nothing_reaches_back_the_oldest_revision_that_can_is_named(school):
    pupil = school.enrol("forgot")
    pupil.teach(0, 1, 2, 3)
    service = school.service
    with service.database.transaction() as session:
        for event in log.events(session, "forgot", 0, 2):
            session.delete(event)
    snapshots.save(service.database, service.files, "forgot", 1, 3, 4, b"state", most=20)
    assert pupil.get("learning")["status"]["reachable"] == [[0, 0], [3, 4]]
    body = pupil.refused("POST", "rollback", 409, "conflict", json={"revision": 1})
    assert body["message"].endswith("is 3")
    assert body["detail"] == [{"field": "revision", "value": "1", "expected": "one of 0, 3 to 4"}]


def test_reach_follows_snapshots_and_what_is_left_of_the_log(database):
    """Ten events; those up to 5 are gone but for the snapshots after 2 and 4, and 8 has gone back behind 7."""
    write(database, *(batch(number) for number in range(7)))
    assert roll_back(database, 6) == 8
    write(database, batch(8), batch(9))

    class Kept:
        def write_snapshot(self, name, payload):
            pass

    for number in (2, 4, 5):
        assert snapshots.save(database, Kept(), MODEL, 1, number, 10, b"", most=20) is not None
    with database.transaction() as session:
        for event in log.events(session, MODEL, 0, 5):
            session.delete(event)
    with database.session() as session:
        assert status.list_reachable(session, MODEL, 1) == [(0, 0), (2, 2), (4, 6), (8, 10)]
        assert status.read_newest_revision(session, MODEL, 1) == 10
    note(database, "settings", {"forgetting_s": 5.0})
    with database.session() as session:
        assert status.list_reachable(session, MODEL, 1)[-1] == (8, 11)


def test_another_version_serves_by_one_call(school):
    pupil = school.enrol("versions")
    pupil.teach(0)
    learnt = pupil.predict()
    school.publish("versions")
    school.service.loaded.adopt("versions")
    as_trained = pupil.predict()
    assert (as_trained["version"], as_trained["revision"]) == (2, 0)
    said = pupil.post("rollback", {"version": 1})
    assert said == {"model": "versions", "version": 1, "revision": 1, "undone": 0, "complete": True}
    back = eventually(lambda: (seen := pupil.predict())["version"] == 1 and seen)
    assert (back["revision"], apart(back, learnt) < EQUAL) == (1, True)
    assert pupil.client.get("/v1/models/versions").json()["serving_version"] == 1
    said = pupil.teach(1)
    assert (said["version"], said["revision"]) == (1, 2)
    assert "serves already" in pupil.refused("POST", "rollback", 409, "conflict", json={"version": 1})["message"]
    pupil.refused("POST", "rollback", 404, "not_found", json={"version": 7})


def test_a_version_of_which_the_log_has_lost_something_says_so(school):
    pupil = school.enrol("lossy")
    database = school.service.database
    write(database, batch(0), batch(1), model="lossy")  # which the learner is not told of: it stores nothing
    school.publish("lossy")
    school.service.loaded.adopt("lossy")
    with database.transaction() as session:
        session.delete(log.find_batch(session, "lossy", "robot-1", 0))
    said = pupil.post("rollback", {"version": 1})
    assert (said["version"], said["complete"]) == (1, False)


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


def test_replayed_rows_go_with_their_batch(school):
    pupil, without = school.enrol("unlearns-replayed", contact_threshold=8.0), school.enrol("not-replayed")
    pupil.teach(0, tau=[[50.0 + 0.1 * row, 50.0] for row in range(LESSON)])
    pupil.teach(1)
    replayed = pupil.post("observations/arm/0/replay", {"codes": ["contact"]})
    pupil.settled(replayed["revision"])
    said = pupil.delete("observations/arm/0")
    assert said["rows"] == LESSON
    left = pupil.settled(said["revision"])
    without.teach(1)
    assert apart(left, without.predict()) < EQUAL
    assert [replay["state"] for replay in pupil.get("observations/arm/0")["replays"]] == ["unlearnt"]


def test_what_was_undone_is_neither_undone_again_nor_replayed(school):
    pupil = school.enrol("unlearns-once")
    pupil.teach(0, 1)
    pupil.delete("observations/arm/0")
    pupil.post("rollback", {"revision": 1})
    for number, reason in ((0, "unlearnt"), (1, "rollback")):
        for method, path in (("DELETE", ""), ("POST", "/replay")):
            request = {"json": {}} if path else {}
            body = pupil.refused(method, f"observations/arm/{number}{path}", 409, "conflict", **request)
            assert reason in body["message"]
    assert [item["state"] for item in pupil.get("observations")["items"]] == ["rolled_back", "unlearnt"]
    assert pupil.get("learning")["status"]["events"] == 4


def test_versions_that_were_trained_since_are_named(school):
    pupil = school.enrol("trained-since")
    pupil.teach(0)
    school.publish("trained-since")
    school.service.loaded.adopt("trained-since")
    assert pupil.predict()["version"] == 2
    assert pupil.teach(1)["revision"] == 1
    assert pupil.delete("observations/arm/0")["trained"] == [2]
    assert pupil.delete("observations/arm/1")["trained"] == []


PUSHED = slice(2, 6)
"""Rows of a lesson during which something pushes."""


def pushed(number):
    """Torques of a lesson with a push that the model cannot explain."""
    tau = np.array(lesson(number)["tau"])
    tau[PUSHED] += 0.5
    return tau.tolist()


def test_replayed_rows_teach_as_if_they_had_been_let_in(school):
    wary, trusting = school.enrol("wary", contact_threshold=8.0), school.enrol("trusting")
    wary.teach(0)
    said = wary.teach(1, tau=pushed(1))
    assert (said["accepted"], said["rejected"]) == (6, {"contact": 4})
    kept_out = wary.predict()
    said = wary.post("observations/arm/1/replay", {"codes": ["contact"]})
    assert said == {
        "model": "wary",
        "version": 1,
        "revision": 3,
        "stream_id": "arm",
        "sequence": 1,
        "rows": 4,
        "codes": {"contact": 4},
    }
    learnt = wary.settled(said["revision"])
    trusting.teach(0)
    trusting.teach(1, tau=pushed(1))
    expected = trusting.predict()
    assert apart(learnt, expected) < EQUAL
    assert apart(kept_out, expected) > 1e3 * EQUAL
    seen = wary.get("observations/arm/1", rows=True)
    assert [(each["event"], each["codes"], each["rows"], each["state"]) for each in seen["replays"]] == [
        (3, ["contact"], 4, "learnt")
    ]
    assert seen["rejected"] == {"contact": 4}  # what was said of it stays


def test_a_row_is_replayed_once(school):
    pupil = school.enrol("once", contact_threshold=8.0)
    q = lesson(0)["q"]
    q[9][0] = 13.0
    pupil.teach(0, tau=pushed(0), q=q)
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["saturation"]})
    assert (body["detail"][0]["field"], body["detail"][0]["value"]) == ("codes", "saturation")
    assert body["detail"][0]["expected"].endswith("limit, contact")
    assert pupil.post("observations/arm/0/replay", {"codes": ["contact"]})["codes"] == {"contact": 4}
    body = pupil.refused("POST", "observations/arm/0/replay", 409, "conflict", json={"codes": ["contact"]})
    assert "contact have been replayed" in body["message"]
    assert pupil.post("observations/arm/0/replay", {})["codes"] == {"limit": 1}  # what is left
    body = pupil.refused("POST", "observations/arm/0/replay", 409, "conflict", json={})
    assert "contact" in body["message"]
    assert "limit" in body["message"]
    assert pupil.get("learning")["status"]["events"] == 3


def test_rows_without_all_numbers_are_never_learnt(school):
    pupil = school.enrol("incomplete")
    tau = lesson(0)["tau"]
    tau[1][1] = None
    pupil.teach(0, tau=tau)
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["non_finite"]})
    assert body["detail"][0]["value"] == "non_finite"
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={})
    assert "there are none" in body["message"]


def test_a_replay_that_was_rolled_back_can_be_made_again(school):
    pupil = school.enrol("again", contact_threshold=8.0)
    pupil.teach(0, tau=pushed(0))
    pupil.teach(1)
    pupil.settled(pupil.post("observations/arm/0/replay", {})["revision"])
    learnt = pupil.predict()
    pupil.settled(pupil.post("rollback", {"revision": 2})["revision"])
    again = pupil.settled(pupil.post("observations/arm/0/replay", {})["revision"])
    assert apart(again, learnt) < EQUAL
    assert [each["state"] for each in pupil.get("observations/arm/0")["replays"]] == ["rolled_back", "learnt"]
