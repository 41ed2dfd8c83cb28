"""Rollback to a revision or version, unlearning of a batch, and replay of rejected rows."""

import numpy as np
import pytest

from service.journal import log, snapshots
from service.learning.control import status
from tests.service.data import error, eventually
from tests.service.learning.batches import MODEL, append_batches, append_event, make_batch, roll_back
from tests.service.learning.learning_models import BATCH_ROWS, max_difference, observation_batch

MAX_DIFFERENCE = 1e-8


def test_rollback_restores_earlier_predictions(learning_service):
    learning_model = learning_service.create_model("returns")
    predictions = [learning_model.predict()]
    for number in range(4):
        learning_model.send_batches(number)
        predictions.append(learning_model.predict())
    reply = learning_model.post("rollback", {"revision": 2})
    assert reply == {"model": "returns", "version": 1, "revision": 5, "undone": 2, "complete": True}
    assert max_difference(learning_model.wait_for_revision(5), predictions[2]) < MAX_DIFFERENCE
    assert max_difference(predictions[4], predictions[2]) > 1e3 * MAX_DIFFERENCE
    states = [item["state"] for item in learning_model.get("observations")["items"]]
    assert states == ["rolled_back", "rolled_back", "learnt", "learnt"]
    reply = learning_model.post("rollback", {"revision": 0})
    assert reply["undone"] == 2
    assert max_difference(learning_model.wait_for_revision(reply["revision"]), predictions[0]) < MAX_DIFFERENCE


def test_rollback_requires_an_older_revision(learning_service):
    learning_model = learning_service.create_model("no-future")
    learning_model.send_batches(0, 1)
    for revision in (2, 3):
        body = learning_model.expect_error("POST", "rollback", 422, "invalid_request", json={"revision": revision})
        assert body["detail"] == [
            {"field": "revision", "value": str(revision), "expected": "less than 2, the newest of version 1"}
        ]


@pytest.mark.parametrize("body", [{}, {"revision": 0, "version": 1}])
def test_rollback_requires_exactly_one_target(learning_service, body):
    answer = learning_service.client.post("/v1/models/panda-sim/rollback", json=body)
    assert error(answer, 422, "invalid_request")["detail"][0]["field"] == "revision or version"


def test_rollback_to_undone_revision_is_rejected(learning_service):
    learning_model = learning_service.create_model("branches")
    learning_model.send_batches(0, 1, 2)
    learning_model.wait_for_revision(learning_model.post("rollback", {"revision": 1})["revision"])
    learning_model.send_batches(3)
    assert learning_model.get("learning")["status"]["reachable"] == [[0, 1], [4, 5]]
    body = learning_model.expect_error("POST", "rollback", 409, "conflict", json={"revision": 2})
    assert body["detail"] == [{"field": "revision", "value": "2", "expected": "one of 0 to 1, 4 to 5"}]
    at_four = learning_model.wait_for_revision(learning_model.post("rollback", {"revision": 4})["revision"])
    other = learning_service.create_model("first-only")
    other.send_batches(0)
    assert max_difference(at_four, other.predict()) < MAX_DIFFERENCE


def test_unreachable_rollback_names_the_reachable_revisions(learning_service):
    learning_model = learning_service.create_model("forgot")
    learning_model.send_batches(0, 1, 2, 3)
    service = learning_service.service
    with service.database.transaction() as session:
        for event in log.events(session, "forgot", 0, 2):
            session.delete(event)
    snapshots.save(service.database, service.files, "forgot", 1, 3, 4, b"state", most=20)
    assert learning_model.get("learning")["status"]["reachable"] == [[0, 0], [3, 4]]
    body = learning_model.expect_error("POST", "rollback", 409, "conflict", json={"revision": 1})
    assert body["message"].endswith("is 3")
    assert body["detail"] == [{"field": "revision", "value": "1", "expected": "one of 0, 3 to 4"}]


def test_reachable_revisions_follow_snapshots_and_log(database):
    """Ten events: 1 to 5 are deleted, 2, 4 and 5 have snapshots, and event 8 rolls back event 7."""
    append_batches(database, *(make_batch(number) for number in range(7)))
    assert roll_back(database, 6) == 8
    append_batches(database, make_batch(8), make_batch(9))

    class DiscardingFiles:
        def write_snapshot(self, name, payload):
            pass

    for number in (2, 4, 5):
        assert snapshots.save(database, DiscardingFiles(), MODEL, 1, number, 10, b"", most=20) is not None
    with database.transaction() as session:
        for event in log.events(session, MODEL, 0, 5):
            session.delete(event)
    with database.session() as session:
        assert status.list_reachable(session, MODEL, 1) == [(0, 0), (2, 2), (4, 6), (8, 10)]
        assert status.read_newest_revision(session, MODEL, 1) == 10
    append_event(database, "settings", {"forgetting_s": 5.0})
    with database.session() as session:
        assert status.list_reachable(session, MODEL, 1)[-1] == (8, 11)


def test_rollback_to_another_version(learning_service):
    learning_model = learning_service.create_model("versions")
    learning_model.send_batches(0)
    learnt = learning_model.predict()
    learning_service.publish("versions")
    learning_service.service.loaded.adopt("versions")
    as_trained = learning_model.predict()
    assert (as_trained["version"], as_trained["revision"]) == (2, 0)
    reply = learning_model.post("rollback", {"version": 1})
    assert reply == {"model": "versions", "version": 1, "revision": 1, "undone": 0, "complete": True}
    back = eventually(lambda: (seen := learning_model.predict())["version"] == 1 and seen)
    assert (back["revision"], max_difference(back, learnt) < MAX_DIFFERENCE) == (1, True)
    assert learning_model.client.get("/v1/models/versions").json()["serving_version"] == 1
    reply = learning_model.send_batches(1)
    assert (reply["version"], reply["revision"]) == (1, 2)
    assert (
        "is already the serving version"
        in learning_model.expect_error("POST", "rollback", 409, "conflict", json={"version": 1})["message"]
    )
    learning_model.expect_error("POST", "rollback", 404, "not_found", json={"version": 7})


def test_rollback_reports_an_incomplete_log(learning_service):
    learning_model = learning_service.create_model("lossy")
    database = learning_service.service.database
    # the learner is not woken and stores no snapshot
    append_batches(database, make_batch(0), make_batch(1), model="lossy")
    learning_service.publish("lossy")
    learning_service.service.loaded.adopt("lossy")
    with database.transaction() as session:
        session.delete(log.find_batch(session, "lossy", "robot-1", 0))
    reply = learning_model.post("rollback", {"version": 1})
    assert (reply["version"], reply["complete"]) == (1, False)


def test_unlearning_leaves_only_the_other_batches(learning_service):
    learning_model, reference = learning_service.create_model("unlearns"), learning_service.create_model("never-learnt")
    learning_model.send_batches(0, 1, 2)
    before = learning_model.predict()
    reply = learning_model.delete("observations/arm/1")
    assert reply == {
        "model": "unlearns",
        "version": 1,
        "revision": 4,
        "stream_id": "arm",
        "sequence": 1,
        "rows": BATCH_ROWS,
        "trained": [],
    }
    left = learning_model.wait_for_revision(reply["revision"])
    reference.send_batches(0, 2)
    expected = reference.predict()
    assert max_difference(left, expected) < MAX_DIFFERENCE
    assert max_difference(before, expected) > 1e3 * MAX_DIFFERENCE
    assert learning_model.get("observations/arm/1")["state"] == "unlearnt"
    assert learning_model.send_batches(1)["duplicate"] is True  # a duplicate is not learnt again
    assert max_difference(learning_model.predict(), expected) < MAX_DIFFERENCE


def test_unlearning_includes_replayed_rows(learning_service):
    learning_model, reference = (
        learning_service.create_model("unlearns-replayed", contact_threshold=8.0),
        learning_service.create_model("not-replayed"),
    )
    learning_model.send_batches(0, tau=[[50.0 + 0.1 * row, 50.0] for row in range(BATCH_ROWS)])
    learning_model.send_batches(1)
    replayed = learning_model.post("observations/arm/0/replay", {"codes": ["contact"]})
    learning_model.wait_for_revision(replayed["revision"])
    reply = learning_model.delete("observations/arm/0")
    assert reply["rows"] == BATCH_ROWS
    left = learning_model.wait_for_revision(reply["revision"])
    reference.send_batches(1)
    assert max_difference(left, reference.predict()) < MAX_DIFFERENCE
    assert [replay["state"] for replay in learning_model.get("observations/arm/0")["replays"]] == ["unlearnt"]


def test_undone_batches_cannot_be_undone_or_replayed(learning_service):
    learning_model = learning_service.create_model("unlearns-once")
    learning_model.send_batches(0, 1)
    learning_model.delete("observations/arm/0")
    learning_model.post("rollback", {"revision": 1})
    for number, reason in ((0, "unlearnt"), (1, "rollback")):
        for method, path in (("DELETE", ""), ("POST", "/replay")):
            request = {"json": {}} if path else {}
            body = learning_model.expect_error(method, f"observations/arm/{number}{path}", 409, "conflict", **request)
            assert reason in body["message"]
    assert [item["state"] for item in learning_model.get("observations")["items"]] == ["rolled_back", "unlearnt"]
    assert learning_model.get("learning")["status"]["events"] == 4


def test_unlearning_lists_versions_trained_on_the_batch(learning_service):
    learning_model = learning_service.create_model("trained-since")
    learning_model.send_batches(0)
    learning_service.publish("trained-since")
    learning_service.service.loaded.adopt("trained-since")
    assert learning_model.predict()["version"] == 2
    assert learning_model.send_batches(1)["revision"] == 1
    assert learning_model.delete("observations/arm/0")["trained"] == [2]
    assert learning_model.delete("observations/arm/1")["trained"] == []


CONTACT_ROWS = slice(2, 6)
"""Rows of a batch with a contact."""


def torque_with_contact(number):
    """Return the torques of a batch with a contact."""
    tau = np.array(observation_batch(number)["tau"])
    tau[CONTACT_ROWS] += 0.5
    return tau.tolist()


def test_replayed_rows_are_learnt_as_if_accepted(learning_service):
    gated, reference = (
        learning_service.create_model("wary", contact_threshold=8.0),
        learning_service.create_model("trusting"),
    )
    gated.send_batches(0)
    reply = gated.send_batches(1, tau=torque_with_contact(1))
    assert (reply["accepted"], reply["rejected"]) == (6, {"contact": 4})
    before_replay = gated.predict()
    reply = gated.post("observations/arm/1/replay", {"codes": ["contact"]})
    assert reply == {
        "model": "wary",
        "version": 1,
        "revision": 3,
        "stream_id": "arm",
        "sequence": 1,
        "rows": 4,
        "codes": {"contact": 4},
    }
    learnt = gated.wait_for_revision(reply["revision"])
    reference.send_batches(0)
    reference.send_batches(1, tau=torque_with_contact(1))
    expected = reference.predict()
    assert max_difference(learnt, expected) < MAX_DIFFERENCE
    assert max_difference(before_replay, expected) > 1e3 * MAX_DIFFERENCE
    seen = gated.get("observations/arm/1", rows=True)
    assert [(each["event"], each["codes"], each["rows"], each["state"]) for each in seen["replays"]] == [
        (3, ["contact"], 4, "learnt")
    ]
    assert seen["rejected"] == {"contact": 4}  # the report of the batch does not change


def test_rows_are_replayed_once(learning_service):
    learning_model = learning_service.create_model("once", contact_threshold=8.0)
    q = observation_batch(0)["q"]
    q[9][0] = 13.0
    learning_model.send_batches(0, tau=torque_with_contact(0), q=q)
    body = learning_model.expect_error(
        "POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["saturation"]}
    )
    assert (body["detail"][0]["field"], body["detail"][0]["value"]) == ("codes", "saturation")
    assert body["detail"][0]["expected"].endswith("limit, contact")
    assert learning_model.post("observations/arm/0/replay", {"codes": ["contact"]})["codes"] == {"contact": 4}
    body = learning_model.expect_error(
        "POST", "observations/arm/0/replay", 409, "conflict", json={"codes": ["contact"]}
    )
    assert "contact have already been replayed" in body["message"]
    assert learning_model.post("observations/arm/0/replay", {})["codes"] == {"limit": 1}  # the remaining rows
    body = learning_model.expect_error("POST", "observations/arm/0/replay", 409, "conflict", json={})
    assert "contact" in body["message"]
    assert "limit" in body["message"]
    assert learning_model.get("learning")["status"]["events"] == 3


def test_incomplete_rows_cannot_be_replayed(learning_service):
    learning_model = learning_service.create_model("incomplete")
    tau = observation_batch(0)["tau"]
    tau[1][1] = None
    learning_model.send_batches(0, tau=tau)
    body = learning_model.expect_error(
        "POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["non_finite"]}
    )
    assert body["detail"][0]["value"] == "non_finite"
    body = learning_model.expect_error("POST", "observations/arm/0/replay", 422, "invalid_request", json={})
    assert "there are none" in body["message"]


def test_rolled_back_replay_can_be_repeated(learning_service):
    learning_model = learning_service.create_model("again", contact_threshold=8.0)
    learning_model.send_batches(0, tau=torque_with_contact(0))
    learning_model.send_batches(1)
    learning_model.wait_for_revision(learning_model.post("observations/arm/0/replay", {})["revision"])
    learnt = learning_model.predict()
    learning_model.wait_for_revision(learning_model.post("rollback", {"revision": 2})["revision"])
    again = learning_model.wait_for_revision(learning_model.post("observations/arm/0/replay", {})["revision"])
    assert max_difference(again, learnt) < MAX_DIFFERENCE
    assert [each["state"] for each in learning_model.get("observations/arm/0")["replays"]] == ["rolled_back", "learnt"]
