"""Unlearning and rolling back: which events are void then, which snapshots go, which settings hold."""

from __future__ import annotations

import pytest

from service.journal import log
from service.storage.database import SnapshotRow, now
from tests.service.learning.batches import (
    MODEL,
    OTHER,
    batch,
    everything,
    live,
    note,
    opened,
    roll_back,
    rows,
    take_back,
    write,
)


@pytest.fixture
def database(home):
    database = opened(home)
    yield database
    database.close()


def test_unlearning_takes_out_a_batch_with_its_replays_and_nothing_else(database):
    write(database, batch(0), batch(1), batch(2))
    replays = [note(database, "replay", {"event": number}, rows=rows()) for number in (2, 1, 2)]
    assert replays == [4, 5, 6]
    write(database, *(batch(k) for k in range(7)), model=OTHER)
    assert take_back(database, 2) == 7
    assert live(database) == [1, 3, 5, 7]
    assert live(database, OTHER) == [1, 2, 3, 4, 5, 6, 7]
    last = everything(database)[-1]
    assert (last.kind, last.detail, last.received, last.rows) == ("unlearn", {"event": 2}, 3000.0, 0)


def test_a_rollback_takes_out_what_came_later_and_leaves_what_was_unlearnt(database):
    write(database, batch(0), batch(1), batch(2))  # 1, 2, 3
    note(database, "change", {"t": 5.0})  # 4
    note(database, "replay", {"event": 1}, rows=rows())  # 5
    take_back(database, 1)  # 6: takes out 1 and 5
    write(database, batch(3), batch(0), model=OTHER)
    assert roll_back(database, 2) == 7
    assert live(database) == [2, 6, 7]
    assert live(database, OTHER) == [1, 2]
    last = everything(database)[-1]
    assert (last.kind, last.detail) == ("rollback", {"to": 2})
    assert write(database, batch(3)) == [8]  # learning goes on
    assert live(database) == [2, 6, 7, 8]


def test_a_rollback_removes_later_snapshots_of_all_versions_of_the_model(database):
    write(database, *(batch(k) for k in range(4)))
    with database.transaction() as session:
        for model, version, number in ((MODEL, 1, 2), (MODEL, 1, 3), (MODEL, 2, 4), (OTHER, 1, 4)):
            name = f"snap_{model}_{number}"
            session.add(SnapshotRow(id=name, model=model, version=version, number=number, created_at=now()))
    roll_back(database, 2)
    with database.session() as session:
        left = {(row.model, row.number) for row in session.query(SnapshotRow)}
    assert left == {(MODEL, 2), (OTHER, 4)}


def test_forgetting_is_what_was_set_last_and_not_rolled_back(database):
    write(database, batch(0))
    note(database, "settings", {"forgetting_s": 60.0})
    note(database, "settings", {"forgetting_s": 30.0}, model=OTHER)
    write(database, batch(1))
    note(database, "settings", {"forgetting_s": None})

    def in_force(*numbers):
        with database.session() as session:
            return [log.forgetting(session, MODEL, number) for number in numbers]

    assert in_force(0, 1, 2, 3, 4) == [None, None, 60.0, 60.0, None]
    roll_back(database, 3)
    assert in_force(5) == [60.0]
    roll_back(database, 1)
    assert in_force(6) == [None]
