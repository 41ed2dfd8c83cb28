"""Routes for learning options, status, decisions after a pause, and alarms."""

import time

import pytest

from service.contract.observations import LearningOptions
from service.foundation.errors import NotFoundError
from service.journal import log, snapshots
from service.journal.alarms import raise_alarm
from service.learning import owner
from service.learning.control import decisions
from tests.service.learning.batches import MODEL, append_batches, list_events, make_batch
from tests.service.learning.learning_models import BATCH_ROWS, LearningModel, max_difference, observation_batch

MAX_DIFFERENCE = 1e-8
DEFAULTS = {
    "enabled": True,
    "forgetting_s": None,
    "friction_walk_s": None,
    "on_change": "hold",
    "torque_limits": None,
    "contact_threshold": 8.0,
    "adaptive_intervals": True,
    "payloads": True,
    "auto_refresh": True,
    "auto_promote": True,
}


def read_offset(learning_model):
    """Return the event time of the first row of the recording."""
    return learning_model.get("learning")["status"]["streams"][0]["offset_s"]


def pause_model(learning_service, learning_model):
    """Pause a model at its next row, as ingest does after a change; return the event time."""
    rows = count_logged_rows(learning_service, learning_model)
    at = read_offset(learning_model) + rows * 0.01 - 0.005
    with learning_service.service.database.transaction() as session:
        number = log.newest(session, learning_model.name) + 1
        owner.pause(session, learning_model.name, {"at": at, "event": number, "evidence": {"joints": ["joint1"]}})
    return at


def count_logged_rows(learning_service, learning_model):
    with learning_service.service.database.session() as session:
        return sum(event.rows for event in log.events(session, learning_model.name, 0, 100) if event.kind == "batch")


def list_changes(learning_service, learning_model):
    with learning_service.service.database.session() as session:
        return [event.detail for event in log.events(session, learning_model.name, 0, 100) if event.kind == "change"]


def test_options_have_defaults(learning_service):
    seen = LearningModel(learning_service.client, "panda-sim").get("learning")
    assert (seen["model"], seen["options"]) == ("panda-sim", DEFAULTS)
    status = seen["status"]
    assert (status["version"], status["revision"], status["published"], status["events"]) == (1, 0, 0, 0)
    assert (status["held"], status["candidate"], status["streams"], status["snapshots"]) == (None, None, [], [])
    assert (status["novel_share"], status["failure"], status["reachable"]) == (None, None, [[0, 0]])


def test_put_replaces_all_options(learning_service):
    learning_model = learning_service.create_model("set")
    wanted = {"forgetting_s": 60.0, "torque_limits": [10.0, 5.0], "on_change": "adapt"}
    assert learning_model.put("learning", wanted)["options"] == DEFAULTS | wanted
    assert learning_model.put("learning", {"contact_threshold": 4.0})["options"] == DEFAULTS | {
        "contact_threshold": 4.0
    }
    assert learning_model.get("learning")["options"] == DEFAULTS | {"contact_threshold": 4.0}


def test_status_shows_revisions_and_streams(learning_service):
    learning_model = learning_service.create_model("stands")
    learning_model.send_batches(0, 1, 5)
    learning_model.send_batches(7, stream_id="second")
    status = learning_model.get("learning")["status"]
    assert (status["revision"], status["published"], status["lag_events"], status["events"]) == (4, 4, 0, 4)
    assert 0 <= status["novel_share"] <= 1
    streams = {each["stream_id"]: each for each in status["streams"]}
    assert (streams["arm"]["last"], streams["arm"]["gaps"], streams["arm"]["missing"]) == (5, [[2, 4]], 3)
    assert (streams["second"]["kind"], streams["second"]["gaps"], streams["second"]["forgotten"]) == (
        "batches",
        [],
        None,
    )
    assert abs(streams["arm"]["offset_s"] - time.time()) < 600


def test_status_lists_snapshots(learning_service):
    learning_model = learning_service.create_model("stored")
    learning_model.send_batches(0, 1)
    service = learning_service.service
    assert snapshots.save(service.database, service.files, "stored", 1, 2, 2, b"state", most=9) is not None
    status = learning_model.get("learning")["status"]
    assert [each["revision"] for each in status["snapshots"]] == [2]


@pytest.mark.parametrize("chunk", [decisions.CHUNK_EVENTS, 1])
def test_adapt_with_replay_learns_held_rows_in_new_regime(learning_service, monkeypatch, chunk):
    """Events are replayed in one transaction, or in one per batch."""
    monkeypatch.setattr(decisions, "CHUNK_EVENTS", chunk)
    paused, reference = learning_service.create_model(f"held-{chunk}"), learning_service.create_model(f"told-{chunk}")
    paused.send_batches(0)
    at = pause_model(learning_service, paused)
    replies = [paused.send_batches(number) for number in (1, 2)]
    assert [each["rejected"] for each in replies] == [{"change": BATCH_ROWS}] * 2
    assert replies[-1]["held"] is True
    assert paused.get("learning")["status"]["held"] == {"at": at, "evidence": {"joints": ["joint1"]}}
    before = paused.predict()

    result = paused.post("learning/change", {"decision": "adapt", "replay": True})
    assert (result["decision"], result["at"], result["rows"]) == ("adapt", at, 2 * BATCH_ROWS)
    assert paused.get("learning")["status"]["held"] is None
    assert list_changes(learning_service, paused) == [{"t": at}]
    adapted = paused.wait_for_revision(result["revision"])

    reference.send_batches(0)
    with learning_service.service.database.transaction() as session:
        log.append(
            session, reference.name, "change", {"t": read_offset(reference) + BATCH_ROWS * 0.01 - 0.005}, time.time()
        )
    reference.send_batches(1, 2)
    assert max_difference(adapted, reference.predict()) < MAX_DIFFERENCE
    assert max_difference(adapted, before) > 1e3 * MAX_DIFFERENCE
    assert paused.send_batches(3)["accepted"] == BATCH_ROWS


def test_ignore_with_replay_equals_uninterrupted_learning(learning_service):
    paused, reference = learning_service.create_model("ignores"), learning_service.create_model("steady")
    paused.send_batches(0)
    pause_model(learning_service, paused)
    paused.send_batches(1)
    result = paused.post("learning/change", {"decision": "ignore", "replay": True})
    assert (result["rows"], list_changes(learning_service, paused)) == (BATCH_ROWS, [])
    reference.send_batches(0, 1)
    assert max_difference(paused.wait_for_revision(result["revision"]), reference.predict()) < MAX_DIFFERENCE


def test_held_rows_are_not_learnt_without_replay(learning_service):
    paused, reference = learning_service.create_model("stay-out"), learning_service.create_model("short")
    paused.send_batches(0)
    pause_model(learning_service, paused)
    paused.send_batches(1)
    assert paused.post("learning/change", {"decision": "ignore"})["rows"] == 0
    paused.send_batches(2)
    reference.send_batches(0, 2)
    assert max_difference(paused.predict(), reference.predict()) < MAX_DIFFERENCE
    assert paused.post("observations/arm/1/replay", {"codes": ["change"]})["rows"] == BATCH_ROWS


def test_decision_without_pause_is_rejected(learning_service):
    learning_model = learning_service.create_model("undecided")
    learning_model.send_batches(0)
    for decision in ("adapt", "ignore"):
        learning_model.expect_error("POST", "learning/change", 409, "conflict", json={"decision": decision})
    learning_model.expect_error("POST", "learning/change", 422, "invalid_request", json={"decision": "wait"})
    assert learning_model.get("learning")["status"]["events"] == 1


def read_options(database, model=MODEL):
    with database.session() as session:
        return owner.read_options(session, model)


def set_options(database, model=MODEL, **fields):
    owner.set_options(database, model, LearningOptions(**fields), 2, 500.0)


def list_other_events(database, model=MODEL):
    return [(event.number, event.kind, event.detail) for event in list_events(database, model) if event.kind != "batch"]


def test_only_time_constants_are_logged_as_settings(database):
    set_options(database, contact_threshold=5.0)
    assert list_other_events(database) == []
    set_options(database, forgetting_s=60.0)
    append_batches(database, make_batch(0))
    set_options(database, forgetting_s=60.0, enabled=False)
    set_options(database, forgetting_s=30.0)
    set_options(database)
    set_options(database, friction_walk_s=1800.0)
    assert list_other_events(database) == [
        (1, "settings", {"forgetting_s": 60.0}),
        (3, "settings", {"forgetting_s": 30.0}),
        (4, "settings", {"forgetting_s": None}),
        (5, "settings", {"forgetting_s": None, "friction_walk_s": 1800.0}),
    ]
    assert list_events(database)[0].received == 500.0
    with pytest.raises(NotFoundError, match="no model 'nobody'"):
        set_options(database, model="nobody")


def test_alarms_are_listed_newest_first(learning_service):
    learning_model = learning_service.create_model("alarmed")
    assert learning_model.get("alarms") == {"items": [], "next_cursor": None}
    with learning_service.service.database.transaction() as session:
        for number, kind in enumerate(("change", "novelty", "refresh", "promotion")):
            raise_alarm(session, "alarmed", kind, f"message {number}", {"number": number, "joints": ["joint1"]})
        raise_alarm(session, "panda-sim", "change", "of another model", {})
    first = learning_model.get("alarms", limit=3)
    rest = learning_model.get("alarms", limit=3, cursor=first["next_cursor"])
    items = first["items"] + rest["items"]
    assert [item["kind"] for item in items] == ["promotion", "refresh", "novelty", "change"]
    assert [item["message"] for item in items] == [f"message {number}" for number in (3, 2, 1, 0)]
    assert items[0]["evidence"] == {"number": 3, "joints": ["joint1"]}
    assert [item["at"] for item in items] == sorted((item["at"] for item in items), reverse=True)
    assert len({item["id"] for item in items}) == 4
    assert rest["next_cursor"] is None


MODEL_ROUTES = (
    "GET learning",
    "PUT learning",
    "POST learning/change",
    "GET quality",
    "GET alarms",
    "GET observations",
    "POST observations",
    "GET observations/arm/0",
    "POST rollback",
    "POST refresh",
)


@pytest.mark.parametrize("request_line", MODEL_ROUTES)
def test_unknown_model_is_not_found(learning_service, request_line):
    method, path = request_line.split()
    body = {
        "observations": observation_batch(0),
        "rollback": {"revision": 0},
        "learning/change": {"decision": "adapt"},
    }.get(path, {})
    LearningModel(learning_service.client, "nobody").expect_error(method, path, 404, "not_found", json=body)
