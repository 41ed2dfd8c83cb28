"""The event log: its numbers, what it keeps of a batch, how batches are found and listed."""

from __future__ import annotations

import threading
from contextlib import suppress

import numpy as np
import pytest

from service.journal import log
from service.journal.log import decode, encode
from service.storage.database import LearnerRow
from service.web.rows import Page
from tests.service.learning.batches import MODEL, OTHER, batch, everything, note, opened, rows, take_back, write


@pytest.fixture
def database(home):
    database = opened(home)
    yield database
    database.close()


def test_a_batch_is_kept_with_all_that_was_said_of_it(database):
    item = batch(7, rows=rows(5, codes=("contact", "limit")), report={"accepted": 3}, record={"rows": 5})
    write(database, item)
    with database.session() as session:
        [event] = log.events(session, MODEL, 0, 10)
    said = {name: getattr(event, name) for name in ("kind", "stream_id", "sequence", "last_sequence", "digest")}
    assert said == {"kind": "batch", "stream_id": "robot-1", "sequence": 7, "last_sequence": 7, "digest": item.digest}
    assert (event.version, event.revision, event.received, event.void) == (1, 0, 1007.0, False)
    assert (event.rows, event.learnt, event.report, event.record) == (5, 3, {"accepted": 3}, {"rows": 5})
    assert (event.first, event.last) == (item.rows.time[0], item.rows.time[-1])
    assert event.payload == encode(item.rows)


def test_each_model_counts_its_own_events_without_a_hole(database):
    assert write(database, batch(0), batch(1)) == [1, 2]
    assert write(database, batch(0), model=OTHER) == [1]
    assert note(database, "change", {"t": 5.0}) == 3
    with suppress(ZeroDivisionError), database.transaction() as session:
        assert log.append_batch(session, MODEL, batch(2)).number == 4
        raise ZeroDivisionError
    assert write(database, batch(2)) == [4]
    with database.session() as session:
        assert [log.newest(session, name) for name in (MODEL, OTHER, "unknown")] == [4, 1, 0]


def test_writers_at_the_same_time_get_numbers_of_their_own(database):
    def writer(name):
        write(database, *(batch(sequence, stream_id=name) for sequence in range(20)))

    threads = [threading.Thread(target=writer, args=(f"robot-{k}",)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [event.number for event in everything(database)] == list(range(1, 81))


def test_times_of_rows_that_have_none_are_left_out(database):
    leaps = rows(4, codes=("time_jump", "non_finite"))
    leaps.time[0], leaps.time[1] = 1e300, np.nan
    write(database, batch(0, rows=leaps), batch(1, rows=leaps.take(slice(0, 2))))
    spans = [(event.first, event.last) for event in everything(database)]
    assert spans == [(leaps.time[2], leaps.time[3]), (None, None)]


def test_events_come_in_order_in_parts_and_without_void_ones(database):
    write(database, *(batch(k) for k in range(5)))
    take_back(database, 2)
    with database.session() as session:
        assert [event.number for event in log.events(session, MODEL, 0, 3)] == [1, 3, 4]
        assert [event.number for event in log.events(session, MODEL, 4, 10)] == [5, 6]
        assert [event.number for event in log.events(session, MODEL, 0, 3, void=True)] == [1, 2, 3]


def test_batches_are_found_by_their_sequence(database):
    write(database, batch(3), batch(8), batch(5), batch(6, stream_id="robot-2"))
    write(database, batch(4), model=OTHER)
    with database.session() as session:

        def at(event):
            return event and event.sequence

        assert at(log.find_batch(session, MODEL, "robot-1", 5)) == 5
        assert log.find_batch(session, MODEL, "robot-1", 4) is None
        assert log.find_batch(session, MODEL, "robot-1", 6) is None
        found = {s: tuple(map(at, log.neighbours(session, MODEL, "robot-1", s))) for s in (2, 3, 6, 8, 9)}
        assert found == {2: (None, 3), 3: (None, 5), 6: (5, 8), 8: (5, None), 9: (8, None)}
        before, _ = log.neighbours(session, MODEL, "robot-1", 4)
        assert decode(before.payload).tau.tolist() == rows(seed=3).tau.tolist()


def test_frames_are_found_in_the_batch_they_lie_in(database):
    write(database, batch(10, 14), batch(20, 29))
    with database.session() as session:
        found = {s: log.covering(session, MODEL, "robot-1", s) for s in (9, 10, 14, 15, 19, 25, 29, 30)}
    starts = {sequence: event and event.sequence for sequence, event in found.items()}
    assert starts == {9: None, 10: 10, 14: 10, 15: None, 19: None, 25: 20, 29: 20, 30: None}


def test_lists_are_paged_newest_first_and_filtered(database):
    write(database, batch(0), batch(1, rows=rows(codes=("contact",))), batch(0, stream_id="robot-2"))
    note(database, "change", {"t": 5.0})
    write(database, batch(0), model=OTHER)

    def numbers(limit=10, after=None, **filters):
        with database.session() as session:
            found, cursor = log.page(session, MODEL, Page(after=after, limit=limit), **filters)
        return [event.number for event in found], cursor

    assert numbers() == ([4, 3, 2, 1], None)
    assert numbers(stream_id="robot-1") == ([2, 1], None)
    assert numbers(rejected=True) == ([2], None)
    assert numbers(kinds=["change", "settings"]) == ([4], None)
    first, cursor = numbers(limit=3)
    assert first == [4, 3, 2]
    assert numbers(limit=3, after=int(cursor)) == ([1], None)


def test_a_version_starts_where_its_row_says(database):
    with database.transaction() as session:
        session.add(LearnerRow(model=MODEL, version=2, start=17, role="serving"))
    with database.session() as session:
        assert [log.start_of(session, MODEL, version) for version in (1, 2)] == [0, 17]


def test_it_is_known_whether_events_have_gone(database):
    write(database, *(batch(k) for k in range(5)))
    with database.transaction() as session:
        session.delete(log.find_batch(session, MODEL, "robot-1", 1))
    with database.session() as session:
        spans = ((0, 1), (0, 2), (1, 2), (2, 5), (1, 5), (3, 3), (2, 9))
        assert [log.is_complete(session, MODEL, *span) for span in spans] == [
            True,
            False,
            False,
            True,
            False,
            True,
            False,
        ]
