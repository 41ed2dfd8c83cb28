"""Rollback to a revision or version, unlearning of a batch, and replay of rejected rows."""

import numpy as np
import pytest

from service.journal import log, snapshots
from service.learning.control import status
from tests.service.data import eventually
from tests.service.learning.batches import MODEL, append_batches, append_event, make_batch, roll_back
from tests.service.learning.learning_models import BATCH_ROWS, max_difference, observation_batch

MAX_DIFFERENCE = 1e-8
CONTACT_ROWS = slice(2, 6)
"""Rows of a batch with a contact."""
ERROR_CODES = {404: "not_found", 409: "conflict", 422: "invalid_request"}


@pytest.fixture
def gated_model(learning_service, learning_model):
    """Model that rejects contacts."""
    return learning_service.create_model(f"{learning_model.name}-gated", contact_threshold=8.0)


@pytest.fixture
def reference(learning_service, learning_model):
    """Model that learns only what another one should retain."""
    return learning_service.create_model(f"{learning_model.name}-reference")


def torque_with_contact(number):
    """Return the torques of a batch with a contact."""
    tau = np.array(observation_batch(number)["tau"])
    tau[CONTACT_ROWS] += 0.5
    return tau.tolist()


def apply_request(learning_model, path, body):
    """Send a request; return the prediction once it contains the revision of the reply."""
    return learning_model.wait_for_revision(learning_model.post(path, body)["revision"])


def read_rejection(learning_model, path, body, status=409):
    """Return the error of a request that is expected to fail."""
    return learning_model.expect_error("POST", path, status, ERROR_CODES[status], json=body)


def publish_version(learning_service, model):
    """Publish a version that serves at once."""
    learning_service.publish(model)
    learning_service.service.loaded.adopt(model)


def assert_predictions(found, expected, before):
    """Check a prediction against the expected one, from which the prediction before differs."""
    assert max_difference(found, expected) < MAX_DIFFERENCE
    assert max_difference(before, expected) > 1e3 * MAX_DIFFERENCE


def test_rollback_restores_earlier_predictions(learning_model):
    predictions = [learning_model.predict()]
    for number in range(4):
        learning_model.send_batches(number)
        predictions.append(learning_model.predict())
    reply = learning_model.post("rollback", {"revision": 2})
    assert reply == {"model": learning_model.name, "version": 1, "revision": 5, "undone": 2, "complete": True}
    assert_predictions(learning_model.wait_for_revision(5), predictions[2], predictions[4])
    states = [item["state"] for item in learning_model.get("observations")["items"]]
    assert states == ["rolled_back", "rolled_back", "learnt", "learnt"]
    reply = learning_model.post("rollback", {"revision": 0})
    assert reply["undone"] == 2
    assert max_difference(learning_model.wait_for_revision(reply["revision"]), predictions[0]) < MAX_DIFFERENCE


def test_rollback_requires_one_target_and_an_older_revision(learning_model):
    learning_model.send_batches(0, 1)
    for revision in (2, 3):
        [item] = read_rejection(learning_model, "rollback", {"revision": revision}, 422)["detail"]
        expected = "less than 2, the newest of version 1"
        assert item == {"field": "revision", "value": str(revision), "expected": expected}
    for body in ({}, {"revision": 0, "version": 1}):
        error = read_rejection(learning_model, "rollback", body, 422)
        assert error["detail"][0]["field"] == "revision or version", body


def test_rollback_to_undone_revision_is_rejected(learning_model, reference):
    learning_model.send_batches(0, 1, 2)
    apply_request(learning_model, "rollback", {"revision": 1})
    learning_model.send_batches(3)
    assert learning_model.get("learning")["status"]["reachable"] == [[0, 1], [4, 5]]
    body = read_rejection(learning_model, "rollback", {"revision": 2})
    assert body["detail"] == [{"field": "revision", "value": "2", "expected": "one of 0 to 1, 4 to 5"}]
    reference.send_batches(0)
    at_four = apply_request(learning_model, "rollback", {"revision": 4})
    assert max_difference(at_four, reference.predict()) < MAX_DIFFERENCE


def test_unreachable_rollback_names_the_reachable_revisions(learning_service, learning_model):
    learning_model.send_batches(0, 1, 2, 3)
    service = learning_service.service
    with service.database.transaction() as session:
        for event in log.events(session, learning_model.name, 0, 2):
            session.delete(event)
    snapshots.save(service.database, service.files, learning_model.name, 1, 3, 4, b"state", most=20)
    assert learning_model.get("learning")["status"]["reachable"] == [[0, 0], [3, 4]]
    body = read_rejection(learning_model, "rollback", {"revision": 1})
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


def test_rollback_to_another_version(learning_service, learning_model):
    learning_model.send_batches(0)
    learnt = learning_model.predict()
    publish_version(learning_service, learning_model.name)
    as_trained = learning_model.predict()
    assert (as_trained["version"], as_trained["revision"]) == (2, 0)
    reply = learning_model.post("rollback", {"version": 1})
    assert reply == {"model": learning_model.name, "version": 1, "revision": 1, "undone": 0, "complete": True}
    back = eventually(lambda: (seen := learning_model.predict())["version"] == 1 and seen)
    assert (back["revision"], max_difference(back, learnt) < MAX_DIFFERENCE) == (1, True)
    shown = learning_model.client.get(f"/v1/models/{learning_model.name}").json()
    assert shown["serving_version"] == 1
    reply = learning_model.send_batches(1)
    assert (reply["version"], reply["revision"]) == (1, 2)
    assert "is already the serving version" in read_rejection(learning_model, "rollback", {"version": 1})["message"]
    read_rejection(learning_model, "rollback", {"version": 7}, 404)


def test_rollback_reports_an_incomplete_log(learning_service, learning_model):
    database = learning_service.service.database
    # the learner is not woken and stores no snapshot
    append_batches(database, make_batch(0), make_batch(1), model=learning_model.name)
    publish_version(learning_service, learning_model.name)
    with database.transaction() as session:
        session.delete(log.find_batch(session, learning_model.name, "robot-1", 0))
    reply = learning_model.post("rollback", {"version": 1})
    assert (reply["version"], reply["complete"]) == (1, False)


def test_unlearning_leaves_only_the_other_batches(learning_model, reference):
    learning_model.send_batches(0, 1, 2)
    before = learning_model.predict()
    reply = learning_model.delete("observations/arm/1")
    batch = {"model": learning_model.name, "version": 1, "stream_id": "arm", "sequence": 1}
    assert reply == {**batch, "revision": 4, "rows": BATCH_ROWS, "trained": []}
    left = learning_model.wait_for_revision(reply["revision"])
    reference.send_batches(0, 2)
    expected = reference.predict()
    assert_predictions(left, expected, before)
    assert learning_model.get("observations/arm/1")["state"] == "unlearnt"
    assert learning_model.send_batches(1)["duplicate"] is True  # a duplicate is not learnt again
    assert max_difference(learning_model.predict(), expected) < MAX_DIFFERENCE


def test_unlearning_includes_replayed_rows(gated_model, reference):
    gated_model.send_batches(0, tau=[[50.0 + 0.1 * row, 50.0] for row in range(BATCH_ROWS)])
    gated_model.send_batches(1)
    apply_request(gated_model, "observations/arm/0/replay", {"codes": ["contact"]})
    reply = gated_model.delete("observations/arm/0")
    assert reply["rows"] == BATCH_ROWS
    left = gated_model.wait_for_revision(reply["revision"])
    reference.send_batches(1)
    assert max_difference(left, reference.predict()) < MAX_DIFFERENCE
    assert [replay["state"] for replay in gated_model.get("observations/arm/0")["replays"]] == ["unlearnt"]


def test_undone_batches_cannot_be_undone_or_replayed(learning_model):
    learning_model.send_batches(0, 1)
    learning_model.delete("observations/arm/0")
    learning_model.post("rollback", {"revision": 1})
    for number, reason in ((0, "unlearnt"), (1, "rollback")):
        path = f"observations/arm/{number}"
        assert reason in learning_model.expect_error("DELETE", path, 409, "conflict")["message"]
        assert reason in read_rejection(learning_model, f"{path}/replay", {})["message"]
    assert [item["state"] for item in learning_model.get("observations")["items"]] == ["rolled_back", "unlearnt"]
    assert learning_model.get("learning")["status"]["events"] == 4


def test_unlearning_lists_versions_trained_on_the_batch(learning_service, learning_model):
    learning_model.send_batches(0)
    publish_version(learning_service, learning_model.name)
    assert learning_model.predict()["version"] == 2
    assert learning_model.send_batches(1)["revision"] == 1
    assert learning_model.delete("observations/arm/0")["trained"] == [2]
    assert learning_model.delete("observations/arm/1")["trained"] == []


def test_replayed_rows_are_learnt_as_if_accepted(gated_model, reference):
    gated_model.send_batches(0)
    reply = gated_model.send_batches(1, tau=torque_with_contact(1))
    assert (reply["accepted"], reply["rejected"]) == (6, {"contact": 4})
    before_replay = gated_model.predict()
    reply = gated_model.post("observations/arm/1/replay", {"codes": ["contact"]})
    batch = {"model": gated_model.name, "version": 1, "stream_id": "arm", "sequence": 1}
    assert reply == {**batch, "revision": 3, "rows": 4, "codes": {"contact": 4}}
    learnt = gated_model.wait_for_revision(reply["revision"])
    reference.send_batches(0)
    reference.send_batches(1, tau=torque_with_contact(1))
    assert_predictions(learnt, reference.predict(), before_replay)
    seen = gated_model.get("observations/arm/1", rows=True)
    [replay] = seen["replays"]
    assert (replay["event"], replay["codes"], replay["rows"], replay["state"]) == (3, ["contact"], 4, "learnt")
    assert seen["rejected"] == {"contact": 4}  # the report of the batch does not change


def test_rows_are_replayed_once(gated_model):
    path, q = "observations/arm/0/replay", observation_batch(0)["q"]
    q[9][0] = 13.0
    gated_model.send_batches(0, tau=torque_with_contact(0), q=q)
    item = read_rejection(gated_model, path, {"codes": ["saturation"]}, 422)["detail"][0]
    assert (item["field"], item["value"]) == ("codes", "saturation")
    assert item["expected"].endswith("limit, contact")
    assert gated_model.post(path, {"codes": ["contact"]})["codes"] == {"contact": 4}
    message = read_rejection(gated_model, path, {"codes": ["contact"]})["message"]
    assert "contact have already been replayed" in message
    assert gated_model.post(path, {})["codes"] == {"limit": 1}  # the remaining rows
    message = read_rejection(gated_model, path, {})["message"]
    assert "contact" in message
    assert "limit" in message
    assert gated_model.get("learning")["status"]["events"] == 3


def test_incomplete_rows_cannot_be_replayed(learning_model):
    path, tau = "observations/arm/0/replay", observation_batch(0)["tau"]
    tau[1][1] = None
    learning_model.send_batches(0, tau=tau)
    assert read_rejection(learning_model, path, {"codes": ["non_finite"]}, 422)["detail"][0]["value"] == "non_finite"
    assert "there are none" in read_rejection(learning_model, path, {}, 422)["message"]


def test_rolled_back_replay_can_be_repeated(gated_model):
    gated_model.send_batches(0, tau=torque_with_contact(0))
    gated_model.send_batches(1)
    learnt = apply_request(gated_model, "observations/arm/0/replay", {})
    apply_request(gated_model, "rollback", {"revision": 2})
    again = apply_request(gated_model, "observations/arm/0/replay", {})
    assert max_difference(again, learnt) < MAX_DIFFERENCE
    assert [each["state"] for each in gated_model.get("observations/arm/0")["replays"]] == ["rolled_back", "learnt"]
