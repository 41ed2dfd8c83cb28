"""One call goes back to an earlier revision or version, and its answers are those of then."""

from __future__ import annotations

import pytest

from service.journal import log, snapshots
from service.learning.control import status
from tests.service.data import error, eventually
from tests.service.learning.batches import MODEL, batch, note, opened, roll_back, write
from tests.service.learning.lessons import apart

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


def test_learning_goes_on_from_there(school):
    pupil, other = school.enrol("goes-on"), school.enrol("straight")
    pupil.teach(0, 1, 2)
    pupil.post("rollback", {"revision": 1})
    pupil.teach(3)
    other.teach(0, 3)
    assert apart(pupil.predict(), other.predict()) < EQUAL


def test_what_was_unlearnt_stays_unlearnt(school):
    pupil, other = school.enrol("stays"), school.enrol("without")
    pupil.teach(0, 1, 2)
    pupil.settled(pupil.delete("observations/arm/0")["revision"])
    pupil.settled(pupil.post("rollback", {"revision": 2})["revision"])
    other.teach(1)
    assert apart(pupil.predict(), other.predict()) < EQUAL


def test_only_an_older_revision_is_gone_back_to(school):
    pupil = school.enrol("no-future")
    pupil.teach(0, 1)
    for revision in (2, 3):
        body = pupil.refused("POST", "rollback", 422, "invalid_request", json={"revision": revision})
        assert body["detail"] == [
            {"field": "revision", "value": str(revision), "expected": "one below 2, the newest of version 1"}
        ]


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "revision or version"),
        ({"revision": 0, "version": 1}, "revision or version"),
        ({"revision": -1}, "revision"),
        ({"version": 0}, "version"),
        ({"revision": 1, "to": 2}, "to"),
    ],
)
def test_exactly_one_goal_is_named(school, body, field):
    answer = school.client.post("/v1/models/panda-sim/rollback", json=body)
    assert error(answer, 422, "invalid_request")["detail"][0]["field"] == field


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
    snapshots.save(service.database, service.files, "forgot", 1, 3, b"state", most=20)
    assert pupil.get("learning")["status"]["reachable"] == [[0, 0], [3, 4]]
    body = pupil.refused("POST", "rollback", 409, "conflict", json={"revision": 1})
    assert body["message"].endswith("is 3")
    assert body["detail"] == [{"field": "revision", "value": "1", "expected": "one of 0, 3 to 4"}]


def test_reach_follows_snapshots_and_what_is_left_of_the_log(home):
    """Ten events; those up to 5 are gone but for the snapshots after 2 and 4, and 8 has gone back behind 7."""
    database = opened(home)
    write(database, *(batch(number) for number in range(7)))
    assert roll_back(database, 6) == 8
    write(database, batch(8), batch(9))

    class Kept:
        def write_snapshot(self, name, payload):
            pass

    for number in (2, 4, 5):
        assert snapshots.save(database, Kept(), MODEL, 1, number, b"", most=20) is not None
    with database.transaction() as session:
        for event in log.events(session, MODEL, 0, 5):
            session.delete(event)
    with database.session() as session:
        assert status.reachable(session, MODEL, 1) == [(0, 0), (2, 2), (4, 6), (8, 10)]
        assert status.current(session, MODEL, 1) == 10
    note(database, "settings", {"forgetting_s": 5.0})
    with database.session() as session:
        assert status.reachable(session, MODEL, 1)[-1] == (8, 11)
    database.close()


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


def test_a_model_that_does_not_exist_has_nothing_to_go_back_to(school):
    error(school.client.post("/v1/models/nobody/rollback", json={"revision": 0}), 404, "not_found")
