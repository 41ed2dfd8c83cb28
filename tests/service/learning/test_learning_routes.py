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


def list_logged(learning_service, learning_model, kind):
    """Return the events of a kind."""
    with learning_service.service.database.session() as session:
        return [event for event in log.events(session, learning_model.name, 0, 100) if event.kind == kind]


def date_next_row(learning_service, learning_model):
    """Return an event time between the last logged row and the next one."""
    rows = sum(event.rows for event in list_logged(learning_service, learning_model, "batch"))
    offset = learning_model.get("learning")["status"]["streams"][0]["offset_s"]  # event time of the first row
    return offset + rows * 0.01 - 0.005


def test_options_have_defaults(learning_service):
    seen = LearningModel(learning_service.client, "panda-sim").get("learning")
    assert (seen["model"], seen["options"]) == ("panda-sim", DEFAULTS)
    status = seen["status"]
    assert (status["version"], status["revision"], status["published"], status["events"]) == (1, 0, 0, 0)
    assert (status["held"], status["candidate"], status["streams"], status["snapshots"]) == (None, None, [], [])
    assert (status["novel_share"], status["failure"], status["reachable"]) == (None, None, [[0, 0]])


def test_put_replaces_all_options(learning_model):
    wanted = {"forgetting_s": 60.0, "torque_limits": [10.0, 5.0], "on_change": "adapt"}
    assert learning_model.put("learning", wanted)["options"] == DEFAULTS | wanted
    wanted = {"contact_threshold": 4.0}
    assert learning_model.put("learning", wanted)["options"] == DEFAULTS | wanted
    assert learning_model.get("learning")["options"] == DEFAULTS | wanted


def test_status_shows_revisions_streams_and_snapshots(learning_service, learning_model):
    learning_model.send_batches(0, 1, 5)
    learning_model.send_batches(7, stream_id="second")
    service = learning_service.service
    assert snapshots.save(service.database, service.files, learning_model.name, 1, 2, 4, b"state", most=9) is not None
    status = learning_model.get("learning")["status"]
    assert (status["revision"], status["published"], status["lag_events"], status["events"]) == (4, 4, 0, 4)
    assert 0 <= status["novel_share"] <= 1
    arm, second = sorted(status["streams"], key=lambda each: each["stream_id"])
    assert (arm["stream_id"], arm["last"], arm["gaps"], arm["missing"]) == ("arm", 5, [[2, 4]], 3)
    assert (second["stream_id"], second["kind"], second["gaps"]) == ("second", "batches", [])
    assert second["forgotten"] is None
    assert abs(arm["offset_s"] - time.time()) < 600
    assert [each["revision"] for each in status["snapshots"]] == [2]


@pytest.mark.parametrize(
    ("decision", "replay", "chunk"),
    [
        ("adapt", True, decisions.CHUNK_EVENTS),
        ("adapt", True, 1),
        ("ignore", True, decisions.CHUNK_EVENTS),
        ("ignore", False, decisions.CHUNK_EVENTS),
    ],
)
def test_decision_learns_held_rows_if_replayed(learning_service, learning_model, monkeypatch, decision, replay, chunk):
    """Events are replayed in one transaction, or in one per batch; `adapt` learns them in a new regime."""
    monkeypatch.setattr(decisions, "CHUNK_EVENTS", chunk)
    reference = learning_service.create_model(f"{learning_model.name}-reference")
    learning_model.send_batches(0)
    at = date_next_row(learning_service, learning_model)
    pause = {"at": at, "event": 2, "evidence": {"joints": ["joint1"]}}
    with learning_service.service.database.transaction() as session:  # as ingest does after a change
        owner.pause(session, learning_model.name, pause)
    replies = [learning_model.send_batches(number) for number in (1, 2)]
    assert [each["rejected"] for each in replies] == [{"change": BATCH_ROWS}] * 2
    assert replies[-1]["held"] is True
    assert learning_model.get("learning")["status"]["held"] == {"at": at, "evidence": {"joints": ["joint1"]}}
    before = learning_model.predict()

    body = {"decision": decision} | ({"replay": True} if replay else {})
    result = learning_model.post("learning/change", body)
    rows = 2 * BATCH_ROWS if replay else 0
    assert (result["decision"], result["at"], result["rows"]) == (decision, at, rows)
    assert learning_model.get("learning")["status"]["held"] is None
    changes = [event.detail for event in list_logged(learning_service, learning_model, "change")]
    assert changes == ([{"t": at}] if decision == "adapt" else [])
    decided = learning_model.wait_for_revision(result["revision"])

    reference.send_batches(0)
    if decision == "adapt":
        detail = {"t": date_next_row(learning_service, reference)}
        with learning_service.service.database.transaction() as session:
            log.append(session, reference.name, "change", detail, time.time())
    if replay:
        reference.send_batches(1, 2)
    assert max_difference(decided, reference.predict()) < MAX_DIFFERENCE
    assert (max_difference(decided, before) > 1e3 * MAX_DIFFERENCE) == replay
    assert learning_model.send_batches(3)["accepted"] == BATCH_ROWS
    reference.send_batches(3)
    assert max_difference(learning_model.predict(), reference.predict()) < MAX_DIFFERENCE
    if not replay:
        assert learning_model.post("observations/arm/1/replay", {"codes": ["change"]})["rows"] == BATCH_ROWS


def test_decision_without_pause_is_rejected(learning_model):
    learning_model.send_batches(0)
    for decision in ("adapt", "ignore"):
        learning_model.expect_error("POST", "learning/change", 409, "conflict", json={"decision": decision})
    assert learning_model.get("learning")["status"]["events"] == 1


def test_only_time_constants_are_logged_as_settings(database):
    def set_options(model=MODEL, **fields):
        owner.set_options(database, model, LearningOptions(**fields), 2, 500.0)

    set_options(contact_threshold=5.0)
    assert list_events(database) == []
    set_options(forgetting_s=60.0)
    append_batches(database, make_batch(0))
    set_options(forgetting_s=60.0, enabled=False)
    set_options(forgetting_s=30.0)
    set_options()
    set_options(friction_walk_s=1800.0)
    first, _, *later = list_events(database)
    assert [(event.number, event.kind, event.detail) for event in (first, *later)] == [
        (1, "settings", {"forgetting_s": 60.0}),
        (3, "settings", {"forgetting_s": 30.0}),
        (4, "settings", {"forgetting_s": None}),
        (5, "settings", {"forgetting_s": None, "friction_walk_s": 1800.0}),
    ]
    assert first.received == 500.0
    with pytest.raises(NotFoundError, match="no model 'nobody'"):
        set_options(model="nobody")


def test_alarms_are_listed_newest_first(learning_service, learning_model):
    assert learning_model.get("alarms") == {"items": [], "next_cursor": None}
    with learning_service.service.database.transaction() as session:
        for number, kind in enumerate(("change", "novelty", "refresh", "promotion")):
            evidence = {"number": number, "joints": ["joint1"]}
            raise_alarm(session, learning_model.name, kind, f"message {number}", evidence)
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
    "GET payload",
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
