"""How a model learns is set and seen, a hold ends by a decision, and its owner is told."""

import time

import pytest

from service.contract.observations import LearningOptions
from service.foundation.errors import NotFoundError
from service.journal import log, snapshots
from service.journal.alarms import raise_alarm
from service.learning import owner
from service.learning.control import decisions
from tests.service.learning.batches import MODEL, batch, everything, write
from tests.service.learning.lessons import LESSON, Pupil, apart, lesson

EQUAL = 1e-8
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


def offset(pupil):
    """Event time of the first row of the recording that lessons are taken from."""
    return pupil.get("learning")["status"]["streams"][0]["offset_s"]


def hold(school, pupil):
    """Hold a model as ingest does once a change is found: at the first row that is to come. Return its event time."""
    rows = log_rows(school, pupil)
    at = offset(pupil) + rows * 0.01 - 0.005
    with school.service.database.transaction() as session:
        number = log.newest(session, pupil.model) + 1
        owner.pause(session, pupil.model, {"at": at, "event": number, "evidence": {"joints": ["joint1"]}})
    return at


def log_rows(school, pupil):
    with school.service.database.session() as session:
        return sum(event.rows for event in log.events(session, pupil.model, 0, 100) if event.kind == "batch")


def changes(school, pupil):
    with school.service.database.session() as session:
        return [event.detail for event in log.events(session, pupil.model, 0, 100) if event.kind == "change"]


def test_a_model_that_nothing_was_set_for_has_the_defaults(school):
    seen = Pupil(school.client, "panda-sim").get("learning")
    assert (seen["model"], seen["options"]) == ("panda-sim", DEFAULTS)
    status = seen["status"]
    assert (status["version"], status["revision"], status["published"], status["events"]) == (1, 0, 0, 0)
    assert (status["held"], status["candidate"], status["streams"], status["snapshots"]) == (None, None, [], [])
    assert (status["novel_share"], status["failure"], status["reachable"]) == (None, None, [[0, 0]])


def test_options_are_set_as_a_whole(school):
    pupil = school.enrol("set")
    wanted = {"forgetting_s": 60.0, "torque_limits": [10.0, 5.0], "on_change": "adapt"}
    assert pupil.put("learning", wanted)["options"] == DEFAULTS | wanted
    assert pupil.put("learning", {"contact_threshold": 4.0})["options"] == DEFAULTS | {"contact_threshold": 4.0}
    assert pupil.get("learning")["options"] == DEFAULTS | {"contact_threshold": 4.0}


def test_where_learning_stands(school):
    pupil = school.enrol("stands")
    pupil.teach(0, 1, 5)
    pupil.teach(7, stream_id="second")
    status = pupil.get("learning")["status"]
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


def test_stored_states_are_listed(school):
    pupil = school.enrol("stored")
    pupil.teach(0, 1)
    service = school.service
    assert snapshots.save(service.database, service.files, "stored", 1, 2, 2, b"state", most=9) is not None
    status = pupil.get("learning")["status"]
    assert [each["revision"] for each in status["snapshots"]] == [2]


@pytest.mark.parametrize("chunk", [decisions.CHUNK_EVENTS, 1])
def test_adapting_learns_what_was_held_in_a_new_regime(school, monkeypatch, chunk):
    """In one transaction, or in as many as there are batches."""
    monkeypatch.setattr(decisions, "CHUNK_EVENTS", chunk)
    held, told = school.enrol(f"held-{chunk}"), school.enrol(f"told-{chunk}")
    held.teach(0)
    at = hold(school, held)
    said = [held.teach(number) for number in (1, 2)]
    assert [each["rejected"] for each in said] == [{"change": LESSON}] * 2
    assert said[-1]["held"] is True
    assert held.get("learning")["status"]["held"] == {"at": at, "evidence": {"joints": ["joint1"]}}
    before = held.predict()

    decided = held.post("learning/change", {"decision": "adapt", "replay": True})
    assert (decided["decision"], decided["at"], decided["rows"]) == ("adapt", at, 2 * LESSON)
    assert held.get("learning")["status"]["held"] is None
    assert changes(school, held) == [{"t": at}]
    adapted = held.settled(decided["revision"])

    told.teach(0)
    with school.service.database.transaction() as session:
        log.append(session, told.model, "change", {"t": offset(told) + LESSON * 0.01 - 0.005}, time.time())
    told.teach(1, 2)
    assert apart(adapted, told.predict()) < EQUAL
    assert apart(adapted, before) > 1e3 * EQUAL
    assert held.teach(3)["accepted"] == LESSON


def test_ignoring_goes_on_as_if_nothing_had_been(school):
    held, steady = school.enrol("ignores"), school.enrol("steady")
    held.teach(0)
    hold(school, held)
    held.teach(1)
    decided = held.post("learning/change", {"decision": "ignore", "replay": True})
    assert (decided["rows"], changes(school, held)) == (LESSON, [])
    steady.teach(0, 1)
    assert apart(held.settled(decided["revision"]), steady.predict()) < EQUAL


def test_without_replay_the_held_rows_stay_out(school):
    held, short = school.enrol("stay-out"), school.enrol("short")
    held.teach(0)
    hold(school, held)
    held.teach(1)
    assert held.post("learning/change", {"decision": "ignore"})["rows"] == 0
    held.teach(2)
    short.teach(0, 2)
    assert apart(held.predict(), short.predict()) < EQUAL
    assert held.post("observations/arm/1/replay", {"codes": ["change"]})["rows"] == LESSON  # later, on its own


def test_there_is_nothing_to_decide_without_a_hold(school):
    pupil = school.enrol("undecided")
    pupil.teach(0)
    for decision in ("adapt", "ignore"):
        pupil.refused("POST", "learning/change", 409, "conflict", json={"decision": decision})
    pupil.refused("POST", "learning/change", 422, "invalid_request", json={"decision": "wait"})
    assert pupil.get("learning")["status"]["events"] == 1


def given(database, model=MODEL):
    with database.session() as session:
        return owner.read_options(session, model)


def put(database, model=MODEL, **fields):
    owner.set_options(database, model, LearningOptions(**fields), 2, 500.0)


def logged(database, model=MODEL):
    return [(event.number, event.kind, event.detail) for event in everything(database, model) if event.kind != "batch"]


def test_only_another_time_constant_is_an_event(database):
    put(database, contact_threshold=5.0)
    assert logged(database) == []
    put(database, forgetting_s=60.0)
    write(database, batch(0))
    put(database, forgetting_s=60.0, enabled=False)
    put(database, forgetting_s=30.0)
    put(database)
    put(database, friction_walk_s=1800.0)
    assert logged(database) == [
        (1, "settings", {"forgetting_s": 60.0}),
        (3, "settings", {"forgetting_s": 30.0}),
        (4, "settings", {"forgetting_s": None}),
        (5, "settings", {"forgetting_s": None, "friction_walk_s": 1800.0}),
    ]
    assert everything(database)[0].received == 500.0
    with pytest.raises(NotFoundError, match="no model 'nobody'"):
        put(database, model="nobody")


def test_alarms_are_listed_newest_first(school):
    pupil = school.enrol("alarmed")
    assert pupil.get("alarms") == {"items": [], "next_cursor": None}
    with school.service.database.transaction() as session:
        for number, kind in enumerate(("change", "novelty", "refresh", "promotion")):
            raise_alarm(session, "alarmed", kind, f"message {number}", {"number": number, "joints": ["joint1"]})
        raise_alarm(session, "panda-sim", "change", "of another model", {})
    first = pupil.get("alarms", limit=3)
    rest = pupil.get("alarms", limit=3, cursor=first["next_cursor"])
    items = first["items"] + rest["items"]
    assert [item["kind"] for item in items] == ["promotion", "refresh", "novelty", "change"]
    assert [item["message"] for item in items] == [f"message {number}" for number in (3, 2, 1, 0)]
    assert items[0]["evidence"] == {"number": 3, "joints": ["joint1"]}
    assert [item["at"] for item in items] == sorted((item["at"] for item in items), reverse=True)
    assert len({item["id"] for item in items}) == 4
    assert rest["next_cursor"] is None


NOBODY = (
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


@pytest.mark.parametrize("request_line", NOBODY)
def test_a_model_that_does_not_exist_has_nothing_of_it(school, request_line):
    method, path = request_line.split()
    body = {
        "observations": lesson(0),
        "rollback": {"revision": 0},
        "learning/change": {"decision": "adapt"},
    }.get(path, {})
    Pupil(school.client, "nobody").refused(method, path, 404, "not_found", json=body)
