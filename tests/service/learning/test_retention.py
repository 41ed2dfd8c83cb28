"""Retention of the log: limits of size and age; events that a version still needs are kept."""

import pytest
from sqlalchemy import select

from lipcore.online.stream import PayloadRecord
from service.foundation.errors import BusyError, ConflictError
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.journal.arrivals import is_forgotten
from service.journal.log import Memory, encode
from service.learning.streams import Streams
from service.storage.database import EventRow, LearnerRow, ServingRow, SnapshotRow, StreamRow, now
from tests.choosing import slow
from tests.service.learning.batches import (
    MODEL,
    OTHER,
    append_batches,
    append_event,
    find_stream,
    list_events,
    make_batch,
    make_rows,
    unlearn_batch,
)
from tests.service.learning.learning_models import observation_batch

BATCH_BYTES = len(encode(make_rows()))


def add_snapshot(database, number, version=1):
    with database.transaction() as session:
        name = f"snap_{version}_{number}"
        session.add(SnapshotRow(id=name, model=MODEL, version=version, number=number, created_at=now()))


def add_learner(database, version, start, role):
    with database.transaction() as session:
        session.add(LearnerRow(model=MODEL, version=version, start=start, role=role))


def run_retention(database, batches=10**6, age=1e12, at=0.0):
    settings = Settings(observation_retention_bytes=max(batches * BATCH_BYTES, 1), observation_retention_s=age)
    return snapshots.retain(database, settings, MODEL, at)


def list_numbers(database, model=MODEL):
    return [event.number for event in list_events(database, model)]


@pytest.mark.parametrize(
    ("snapshot_numbers", "limits", "deleted"),
    [
        ([9], {"batches": 10}, 0),
        ([9], {"batches": 6}, 4),
        ([10], {"batches": 1}, 9),
        ([9], {"age": 100.0, "at": 1103.0}, 3),  # received at 1000, 1001, ...
        ([], {"batches": 0}, 0),
        ([3, 6], {"batches": 0}, 6),
    ],
    ids=["size kept", "size exceeded", "one left", "age exceeded", "no snapshot", "newer than the snapshots"],
)
@pytest.mark.parametrize("chunk", [3, snapshots.CHUNK_EVENTS])
def test_oldest_events_in_a_snapshot_are_deleted_beyond_the_limits(
    database, monkeypatch, snapshot_numbers, limits, deleted, chunk
):
    """Deletion spans several transactions, or one."""
    monkeypatch.setattr(snapshots, "CHUNK_EVENTS", chunk)
    for model in (MODEL, OTHER):
        append_batches(database, *(make_batch(k) for k in range(10)), model=model)
    for number in snapshot_numbers:
        add_snapshot(database, number)
    for expected in (deleted, 0):
        assert run_retention(database, **limits) == expected
        assert list_numbers(database) == list(range(deleted + 1, 11))
    assert list_numbers(database, OTHER) == list(range(1, 11))
    assert append_batches(database, make_batch(10)) == [11]  # numbering continues


def test_events_needed_by_the_learning_version_are_kept(database):
    append_batches(database, *(make_batch(k) for k in range(10)))
    with database.transaction() as session:
        session.get_one(ServingRow, MODEL).version = 2
    add_learner(database, 2, 2, "serving")  # trained on events 1 and 2, no snapshot yet
    add_learner(database, 4, 0, "dismissed")
    add_snapshot(database, 1, version=1)  # a former serving version
    assert run_retention(database, batches=0) == 2
    add_snapshot(database, 5, version=2)
    assert run_retention(database, batches=0) == 3
    assert list_numbers(database) == [6, 7, 8, 9, 10]


def test_current_settings_outlive_deleted_batches(database):
    append_event(database, "settings", {"forgetting_s": 60.0})  # 1
    append_batches(database, make_batch(0), make_batch(1))  # 2, 3
    append_event(database, "change", {"t": 5.0})  # 4
    append_event(database, "replay", {"event": 2}, rows=make_rows())  # 5
    unlearn_batch(database, 2)  # 6: voids 2 and 5
    append_batches(database, make_batch(2))  # 7
    add_snapshot(database, 7)
    assert run_retention(database, batches=1) == 3  # 2, 3 and 5
    assert list_numbers(database) == [1, 6, 7]
    with database.session() as session:
        assert log.memory(session, MODEL, 7) == Memory(60.0)


def test_events_needed_to_unlearn_a_batch_are_kept(database):
    append_batches(database, make_batch(0), make_batch(1), make_batch(2))  # 1, 2, 3
    add_snapshot(database, 1)
    add_snapshot(database, 3)
    unlearn_batch(database, 2)  # 4: the snapshot after 3 contains it
    assert run_retention(database, batches=0) == 1
    assert list_numbers(database) == [2, 3, 4]
    add_snapshot(database, 4)
    append_batches(database, make_batch(3))  # 5
    assert run_retention(database, batches=0) == 2
    assert list_numbers(database) == [5]


def test_deleted_batches_are_still_recognised(database):
    append_batches(database, *(make_batch(k, stream_id="robot-2") for k in (0, 1)))
    append_batches(database, *(make_batch(k) for k in (4, 6, 5, 9)))
    add_snapshot(database, 6)
    assert run_retention(database, batches=1) == 5
    robot = find_stream(database)
    assert (robot.forgotten, find_stream(database, "robot-2").forgotten) == (6, 1)
    assert [is_forgotten(robot, k) for k in (3, 4, 5, 6, 7, 9)] == [False, True, True, True, False, False]


def append_limited(database, stream_id, received, max_streams):
    """Log the first batch of a stream of a model that keeps a limited number of streams."""
    with database.transaction() as session:
        log.append_batch(session, MODEL, make_batch(0, stream_id=stream_id, received=received), max_streams=max_streams)


@pytest.mark.parametrize("runs", [60, slow(10_000)])
def test_longest_silent_stream_is_replaced(database, runs):
    def run(number, received):
        append_limited(database, f"run-{number}", received, max_streams=20)

    for number in range(runs):
        run(number, 1000.0 + number)
    with database.session() as session:
        left = set(session.scalars(select(StreamRow.stream_id)))
    assert left == {f"run-{number}" for number in range(runs - 20, runs)}
    with pytest.raises(ConflictError, match="up to batch 0, was deleted: continue with higher sequences"):
        run(0, 1e5)
    append_batches(database, make_batch(1, stream_id="run-0", received=1e5))
    add_snapshot(database, runs + 1)
    assert run_retention(database, batches=0) == runs  # including batches of replaced streams


def test_silent_streams_without_payload_are_deleted(database):
    body = {"mass": 1.0, "com": [0.0, 0.0, 0.1], "inertia": None}
    payloads = {
        "nothing": None,
        "gone": PayloadRecord(1, 0.0, body=None),
        "put-down": PayloadRecord(1, 0.0, {"held": None}, 1),
        "declared": PayloadRecord(1, 0.0, body=body),
        "noticed": PayloadRecord(1, 0.0, {"held": {}}, 1),
    }
    for received, name in enumerate([*payloads, "young"]):
        append_batches(database, make_batch(0, stream_id=name, received=1000.0 + received))
    with database.transaction() as session:
        streams = Streams.restored(session, MODEL)
        for name, payload in payloads.items():
            log.stream(session, MODEL, name).record = streams.change(name, payload=payload).to_json()
        session.flush()
        streams.expire(session, MODEL, 1004.5)
    assert set(streams.all()) == {"declared", "noticed", "young"}
    with database.session() as session:
        assert set(Streams.restored(session, MODEL).all()) == set(streams.all())


def test_active_streams_are_not_replaced(database):
    for number in range(3):
        append_batches(database, make_batch(0, stream_id=f"robot-{number}", received=1000.0 + number))
    with pytest.raises(BusyError, match="3 active streams"):
        append_limited(database, "new", 1009.0, max_streams=3)
    append_limited(database, "new", 1011.0, max_streams=3)
    assert find_stream(database, "robot-0") is None
    assert find_stream(database, "robot-1") is not None


@pytest.mark.slow
def test_observations_and_streams_of_an_idle_model_are_deleted(learning_service, monkeypatch):
    idle, parts = learning_service.create_model(), learning_service.service
    idle.send_batches(0, 1, 2)
    with parts.database.transaction() as session:
        rows = list(session.scalars(select(EventRow).where(EventRow.model == idle.name)))
        for row in [*rows, session.get_one(StreamRow, (idle.name, "arm"))]:
            row.received -= 7200.0
        session.add(SnapshotRow(id="snap_idle", model=idle.name, version=1, number=3, created_at=now()))
    limited = parts.settings.model_copy(update={"observation_retention_s": 3600.0})
    monkeypatch.setattr(parts.learners._log, "settings", limited)
    parts.learners.retain()
    assert [event.number for event in list_events(parts.database, idle.name)] == [3]  # the next number follows it
    assert find_stream(parts.database, "arm", idle.name) is None
    assert idle.post("observations", observation_batch(3, "new"))["state"] == "learnt"
