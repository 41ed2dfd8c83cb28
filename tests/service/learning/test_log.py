"""The event log: its numbers, its rows, how batches are found and taken back, and which of a stream have not come."""

import dataclasses
import json
import threading
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES
from service.foundation.errors import ConflictError
from service.journal import log
from service.journal.arrivals import MAX_RANGES, Gaps
from service.journal.log import decode, encode
from service.storage.database import SnapshotRow, now
from tests.service.learning.batches import (
    MODEL,
    OTHER,
    batch,
    everything,
    live,
    note,
    roll_back,
    rows,
    source,
    take_back,
    write,
)


def test_each_model_counts_its_own_events_without_a_hole(database):
    assert write(database, batch(0), batch(1)) == [1, 2]
    assert write(database, batch(0), model=OTHER) == [1]
    assert note(database, "change", {"t": 5.0}) == 3
    with suppress(ZeroDivisionError), database.transaction() as session:
        assert log.append_batch(session, MODEL, batch(2))[0].number == 4
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


def test_a_stream_goes_on_as_it_began_and_takes_nothing_twice(database):
    write(database, batch(2), batch(5), batch(0, 4, stream_id="robot-2"), batch(7, 9, stream_id="robot-2"))
    assert source(database, "robot-2").missing["ranges"] == [[5, 6]]
    with database.transaction() as session:
        log.stream(session, MODEL, "robot-1").forgotten = 4
    for refused, reason in (
        (batch(2, 3), "'robot-1' of model 'arm' carries batches, not frames: use another"),
        (batch(5, stream_id="robot-2"), "'robot-2' of model 'arm' carries frames, not batches"),
        (batch(9, 10, stream_id="robot-2"), "has come to frame 9, frame 9 does not go on from there"),
        (batch(2), "batch 2 of stream 'robot-1' of model 'arm' may have come before"),
    ):
        with pytest.raises(ConflictError, match=reason):
            write(database, refused)
    assert write(database, batch(3), batch(1)) == [5, 6]  # known not to have come


def misses(seen):
    """Ranges that are missing, by looking at every number."""
    out = []
    for number in range(min(seen), max(seen)):
        if number not in seen:
            if out and out[-1][1] == number - 1:
                out[-1][1] = number
            else:
                out.append([number, number])
    return out


SEQUENCES = st.lists(st.integers(0, 25), min_size=1, max_size=15, unique=True)


@given(SEQUENCES)
def test_the_gaps_are_right_after_every_arrival_in_any_order(sequences):
    known = Gaps(sequences[0], sequences[0])
    for count, sequence in enumerate(sequences, start=1):
        known = Gaps.from_json(known.arrived(sequence, sequence).to_json(), known.arrived(sequence, sequence).last)
        seen = set(sequences[:count])
        assert known.to_json() == {"first": min(seen), "ranges": misses(seen)}
        assert [s for s in range(-1, 27) if known.may_contain(s)] == sorted(seen)


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 5)), min_size=1, max_size=10))
def test_the_gaps_of_ranges_are_right_even_where_they_overlap(spans):
    known = Gaps(spans[0][0], sum(spans[0]))
    seen = set()
    for first, more in spans:
        known = known.arrived(first, first + more)
        seen |= set(range(first, first + more + 1))
    assert (known.first, known.last, [list(pair) for pair in known.ranges]) == (min(seen), max(seen), misses(seen))


def test_only_the_newest_of_very_many_gaps_are_remembered():
    known = Gaps(0, 0)
    for sequence in range(2, 2 * MAX_RANGES + 6, 2):
        known = known.arrived(sequence, sequence)
    assert len(known.ranges) == MAX_RANGES
    assert (known.ranges[0], known.ranges[-1]) == ((5, 5), (2003, 2003))
    assert known.may_contain(3)  # it may have, for all that is known


ANY = st.floats(width=64, allow_nan=True, allow_infinity=True)


@st.composite
def any_rows(draw):
    count, n = draw(st.integers(0, 6)), draw(st.integers(1, 4))
    code = draw(arrays(np.uint8, count, elements=st.integers(0, len(CODES) - 1)))
    return Rows(
        draw(arrays(float, count, elements=ANY)),
        *(draw(arrays(float, (count, n), elements=ANY)) for _ in range(4)),
        code,
        draw(arrays(float, count, elements=ANY)),
    )


def same(one: Rows, other: Rows) -> bool:
    pairs = [(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(Rows)]
    return all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


@given(any_rows())
def test_every_bit_comes_back(given_rows):
    assert same(decode(encode(given_rows)), given_rows)


def test_any_reader_of_safetensors_understands_it():
    data = encode(rows(3))
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert {name: (entry["dtype"], entry["shape"]) for name, entry in header.items() if name != "__metadata__"} == {
        "time": ("F64", [3]),
        **dict.fromkeys(("q", "dq", "ddq", "tau"), ("F64", [3, 2])),
        "code": ("U8", [3]),
        "weight": ("F64", [3]),
    }


@pytest.mark.parametrize("length", [0, 7, 40, -1])
def test_what_is_cut_off_is_refused(length):
    with pytest.raises(ValueError, match="cannot be read"):
        decode(encode(rows())[:length])
