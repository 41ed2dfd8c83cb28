"""The log stays within its size and age, and nothing goes that a version has still to learn."""

import pytest
from sqlalchemy import select

from lipcore.online.stream import PayloadRecord
from service.foundation.errors import BusyError, ConflictError
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.journal.arrivals import is_forgotten
from service.journal.log import Memory, encode
from service.learning.streams import Streams
from service.storage.database import LearnerRow, ServingRow, SnapshotRow, StreamRow, now
from tests.choosing import slow
from tests.service.learning.batches import MODEL, OTHER, batch, everything, note, rows, source, take_back, write

SIZE = len(encode(rows()))
LATE = 1e9


def snapshot(database, number, version=1):
    with database.transaction() as session:
        name = f"snap_{version}_{number}"
        session.add(SnapshotRow(id=name, model=MODEL, version=version, number=number, created_at=now()))


def learner(database, version, start, role):
    with database.transaction() as session:
        session.add(LearnerRow(model=MODEL, version=version, start=start, role=role))


def retain(database, batches=10**6, age=1e12, at=0.0, model=MODEL):
    settings = Settings(observation_retention_bytes=max(batches * SIZE, 1), observation_retention_s=age)
    return snapshots.retain(database, settings, model, at)


def kept(database, model=MODEL):
    return [event.number for event in everything(database, model)]


def test_the_oldest_go_until_the_rest_is_small_enough(database):
    write(database, *(batch(k) for k in range(10)))
    write(database, *(batch(k) for k in range(10)), model=OTHER)
    snapshot(database, 9)
    assert retain(database, batches=10) == 0
    assert retain(database, batches=6) == 4
    assert kept(database) == [5, 6, 7, 8, 9, 10]
    assert kept(database, OTHER) == list(range(1, 11))
    assert retain(database, batches=6) == 0


def test_those_that_are_too_old_go(database):
    write(database, *(batch(k) for k in range(10)))  # received at 1000, 1001, ...
    snapshot(database, 9)
    assert retain(database, age=100.0, at=1103.0) == 3
    assert kept(database) == [4, 5, 6, 7, 8, 9, 10]


def test_more_go_than_one_transaction_deletes(database, monkeypatch):
    monkeypatch.setattr(snapshots, "CHUNK_EVENTS", 3)
    write(database, *(batch(k) for k in range(12)))
    snapshot(database, 12)
    assert retain(database, batches=1) == 11
    assert kept(database) == [12]
    assert write(database, batch(12)) == [13]  # numbers go on


def test_what_is_in_no_snapshot_stays(database):
    write(database, *(batch(k) for k in range(10)))
    assert retain(database, batches=0) == 0
    snapshot(database, 3)
    snapshot(database, 6)
    assert retain(database, batches=0) == 6
    assert kept(database) == [7, 8, 9, 10]


def test_what_the_version_that_learns_needs_stays(database):
    write(database, *(batch(k) for k in range(10)))
    with database.transaction() as session:
        session.get_one(ServingRow, MODEL).version = 2
    learner(database, 2, 2, "serving")  # trained on 1 and 2, no snapshot yet
    learner(database, 4, 0, "dismissed")
    snapshot(database, 1, version=1)  # served once
    assert retain(database, batches=0) == 2
    snapshot(database, 5, version=2)
    assert retain(database, batches=0) == 3
    assert kept(database) == [6, 7, 8, 9, 10]


def test_other_events_go_with_the_batches_but_settings_in_force_stay(database):
    note(database, "settings", {"forgetting_s": 60.0})  # 1
    write(database, batch(0), batch(1))  # 2, 3
    note(database, "change", {"t": 5.0})  # 4
    note(database, "replay", {"event": 2}, rows=rows())  # 5
    take_back(database, 2)  # 6: takes out 2 and 5
    write(database, batch(2))  # 7
    snapshot(database, 7)
    assert retain(database, batches=1) == 3  # 2, 3 and 5
    assert kept(database) == [1, 6, 7]
    with database.session() as session:
        assert log.memory(session, MODEL, 7) == Memory(60.0)


def test_what_is_to_be_folded_again_without_a_batch_stays(database):
    write(database, batch(0), batch(1), batch(2))  # 1, 2, 3
    snapshot(database, 1)
    snapshot(database, 3)
    take_back(database, 2)  # 4: the snapshot after 3 contains it
    assert retain(database, batches=0) == 1
    assert kept(database) == [2, 3, 4]
    snapshot(database, 4)
    write(database, batch(3))  # 5
    assert retain(database, batches=0) == 2
    assert kept(database) == [5]


def test_a_deleted_batch_is_not_taken_for_a_new_one(database):
    write(database, *(batch(k, stream_id="robot-2") for k in (0, 1)))
    write(database, *(batch(k) for k in (4, 6, 5, 9)))
    snapshot(database, 6)
    assert retain(database, batches=1) == 5
    robot = source(database)
    assert (robot.forgotten, source(database, "robot-2").forgotten) == (6, 1)
    assert [is_forgotten(robot, k) for k in (3, 4, 5, 6, 7, 9)] == [False, True, True, True, False, False]


@pytest.mark.parametrize("runs", [60, slow(10_000)])
def test_every_run_has_a_stream_of_its_own_and_the_longest_silent_makes_room(database, runs):
    def run(number, received, **fields):
        with database.transaction() as session:
            arrived = batch(0, stream_id=f"run-{number}", received=received, **fields)
            log.append_batch(session, MODEL, arrived, max_streams=20)

    for number in range(runs):
        run(number, 1000.0 + number)
    with database.session() as session:
        left = set(session.scalars(select(StreamRow.stream_id)))
    assert left == {f"run-{number}" for number in range(runs - 20, runs)}
    with pytest.raises(ConflictError, match="batches up to 0 have come: go on with higher sequences"):
        run(0, 1e5)
    write(database, batch(1, stream_id="run-0", received=1e5))
    snapshot(database, runs + 1)
    assert retain(database, batches=0) == runs  # also those of streams that nobody knows any more


def test_streams_that_are_silent_for_long_are_deleted_unless_they_carry_something(database):
    body = {"mass": 1.0, "com": [0.0, 0.0, 0.1], "inertia": None}
    gone, put_down = PayloadRecord(1, 0.0, body=None), PayloadRecord(1, 0.0, {"held": None}, 1)
    held = (PayloadRecord(1, 0.0, body=body), PayloadRecord(1, 0.0, {"held": {}}, 1))
    payloads = {"nothing": None, "gone": gone, "put-down": put_down, "declared": held[0], "noticed": held[1]}
    for received, name in enumerate([*payloads, "young"]):
        write(database, batch(0, stream_id=name, received=1000.0 + received))
    with database.transaction() as session:
        streams = Streams.restored(session, MODEL)
        for name, payload in payloads.items():
            log.stream(session, MODEL, name).record = streams.change(name, payload=payload).to_json()
        session.flush()
        streams.expire(session, MODEL, 1004.5)
    assert set(streams.all()) == {"declared", "noticed", "young"}
    with database.session() as session:
        assert set(Streams.restored(session, MODEL).all()) == set(streams.all())


def test_streams_in_use_make_no_room(database):
    for number in range(3):
        write(database, batch(0, stream_id=f"robot-{number}", received=1000.0 + number))
    with database.transaction() as session, pytest.raises(BusyError, match="3 sources of observations in use"):
        log.append_batch(session, MODEL, batch(0, stream_id="new", received=1009.0), max_streams=3)
    with database.transaction() as session:
        log.append_batch(session, MODEL, batch(0, stream_id="new", received=1011.0), max_streams=3)
    assert source(database, "robot-0") is None
    assert source(database, "robot-1") is not None
