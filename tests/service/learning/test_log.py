"""The event log: event numbers, undoing, gaps of streams, and the encoding of rows."""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lipcore.online.batch import ARRAYS, Rows
from lipcore.vocabulary import CODES
from service.foundation.errors import ConflictError
from service.journal import log
from service.journal.arrivals import MAX_RANGES, Gaps
from service.journal.log import decode, encode
from service.storage.database import LearningRow, SnapshotRow, now
from tests.service.learning.batches import (
    MODEL,
    OTHER,
    append_batches,
    append_event,
    find_stream,
    list_events,
    list_valid_numbers,
    make_batch,
    make_rows,
    roll_back,
    unlearn_batch,
)


def test_event_numbers_are_contiguous_per_model(database):
    assert append_batches(database, make_batch(0), make_batch(1)) == [1, 2]
    assert append_batches(database, make_batch(0), model=OTHER) == [1]
    assert append_event(database, "change", {"t": 5.0}) == 3
    with suppress(ZeroDivisionError), database.transaction() as session:
        assert log.append_batch(session, MODEL, make_batch(2))[0].number == 4
        raise ZeroDivisionError
    assert append_batches(database, make_batch(2)) == [4]
    with database.session() as session:
        assert [log.newest(session, name) for name in (MODEL, OTHER, "unknown")] == [4, 1, 0]


def test_concurrent_writers_get_distinct_numbers(database):
    def writer(name):
        append_batches(database, *(make_batch(sequence, stream_id=name) for sequence in range(20)))

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(writer, (f"robot-{k}" for k in range(4))))
    assert [event.number for event in list_events(database)] == list(range(1, 81))


def test_event_span_ignores_rows_without_valid_time(database):
    leaps = make_rows(4, codes=("time_jump", "non_finite"))
    leaps.time[0], leaps.time[1] = 1e300, np.nan
    append_batches(database, make_batch(0, rows=leaps), make_batch(1, rows=leaps.take(slice(0, 2))))
    spans = [(event.first, event.last) for event in list_events(database)]
    assert spans == [(leaps.time[2], leaps.time[3]), (None, None)]


@pytest.mark.parametrize(
    ("options", "arrivals", "clocks"),
    [
        ({}, [1000.0, 1003.0, 1004.0], [1000.0, 1003.0, 1004.0]),
        ({}, [1000.0, 10.0, 12.0], [1000.0, 1000.0, 1002.0]),  # the host's clock is set back
        ({"forgetting_s": 5.0}, [1000.0, 9e9, 9e9 + 1.0], [1000.0, 1005.0, 1006.0]),  # it jumps ahead
        ({"forgetting_s": 5.0, "friction_walk_s": 2.0}, [1000.0, 1003.0, 1004.0], [1000.0, 1002.0, 1003.0]),
    ],
)
def test_clock_never_runs_back_and_advances_at_most_by_the_shortest_time_constant(database, options, arrivals, clocks):
    with database.transaction() as session:
        session.add(LearningRow(model=MODEL, options=options))
    append_batches(database, *(make_batch(number, received=received) for number, received in enumerate(arrivals)))
    assert [event.clock for event in list_events(database)] == clocks


def test_unlearning_voids_a_batch_and_its_replays_only(database):
    append_batches(database, make_batch(0), make_batch(1), make_batch(2))
    replays = [append_event(database, "replay", {"event": number}, rows=make_rows()) for number in (2, 1, 2)]
    assert replays == [4, 5, 6]
    append_batches(database, *(make_batch(k) for k in range(7)), model=OTHER)
    assert unlearn_batch(database, 2) == 7
    assert list_valid_numbers(database) == [1, 3, 5, 7]
    assert list_valid_numbers(database, OTHER) == [1, 2, 3, 4, 5, 6, 7]
    last = list_events(database)[-1]
    assert (last.kind, last.detail, last.received, last.rows) == ("unlearn", {"event": 2}, 3000.0, 0)


def test_rollback_voids_later_events_and_keeps_unlearning(database):
    append_batches(database, make_batch(0), make_batch(1), make_batch(2))  # 1, 2, 3
    append_event(database, "change", {"t": 5.0})  # 4
    append_event(database, "replay", {"event": 1}, rows=make_rows())  # 5
    unlearn_batch(database, 1)  # 6: voids 1 and 5
    append_batches(database, make_batch(3), make_batch(0), model=OTHER)
    assert roll_back(database, 2) == 7
    assert list_valid_numbers(database) == [2, 6, 7]
    assert list_valid_numbers(database, OTHER) == [1, 2]
    last = list_events(database)[-1]
    assert (last.kind, last.detail) == ("rollback", {"to": 2})
    assert append_batches(database, make_batch(3)) == [8]  # learning continues
    assert list_valid_numbers(database) == [2, 6, 7, 8]


def test_rollback_deletes_later_snapshots_of_all_versions(database):
    append_batches(database, *(make_batch(k) for k in range(4)))
    with database.transaction() as session:
        for model, version, number in ((MODEL, 1, 2), (MODEL, 1, 3), (MODEL, 2, 4), (OTHER, 1, 4)):
            name = f"snap_{model}_{number}"
            session.add(SnapshotRow(id=name, model=model, version=version, number=number, created_at=now()))
    roll_back(database, 2)
    with database.session() as session:
        left = {(row.model, row.number) for row in session.query(SnapshotRow)}
    assert left == {(MODEL, 2), (OTHER, 4)}


def test_stream_rejects_other_kinds_and_duplicates(database):
    append_batches(database, make_batch(2), make_batch(5))
    append_batches(database, make_batch(0, 4, stream_id="robot-2"), make_batch(7, 9, stream_id="robot-2"))
    assert find_stream(database, "robot-2").missing["ranges"] == [[5, 6]]
    with database.transaction() as session:
        log.stream(session, MODEL, "robot-1").forgotten = 4
    for refused, reason in (
        (make_batch(2, 3), "'robot-1' of model 'arm' consists of batches, not frames: use another"),
        (make_batch(5, stream_id="robot-2"), "'robot-2' of model 'arm' consists of frames, not batches"),
        (make_batch(9, 10, stream_id="robot-2"), "has reached frame 9: frame 9 is not newer"),
        (make_batch(2), "batch 2 of stream 'robot-1' of model 'arm' may be a repetition"),
    ):
        with pytest.raises(ConflictError, match=reason):
            append_batches(database, refused)
    assert append_batches(database, make_batch(3), make_batch(1)) == [5, 6]  # known gaps


def find_missing_ranges(seen):
    """Return the missing ranges by checking every number."""
    missing = set(range(min(seen), max(seen))) - set(seen)
    starts, ends = (sorted(each for each in missing if each + step not in missing) for step in (-1, 1))
    return [list(pair) for pair in zip(starts, ends, strict=True)]


@given(st.lists(st.integers(0, 25), min_size=1, max_size=15, unique=True))
def test_gaps_are_right_after_arrivals_in_any_order(sequences):
    gaps = Gaps(sequences[0], sequences[0])
    for count, sequence in enumerate(sequences, start=1):
        gaps = gaps.arrived(sequence, sequence)
        gaps = Gaps.from_json(gaps.to_json(), gaps.last)
        seen = set(sequences[:count])
        assert gaps.to_json() == {"first": min(seen), "ranges": find_missing_ranges(seen)}
        assert [s for s in range(-1, 27) if gaps.may_contain(s)] == sorted(seen)


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 5)), min_size=1, max_size=10))
def test_gaps_are_right_for_overlapping_ranges(spans):
    gaps = Gaps(spans[0][0], sum(spans[0]))
    seen = set()
    for first, more in spans:
        gaps = gaps.arrived(first, first + more)
        seen |= set(range(first, first + more + 1))
    assert (gaps.first, gaps.last) == (min(seen), max(seen))
    assert [list(pair) for pair in gaps.ranges] == find_missing_ranges(seen)


def test_only_the_newest_gaps_are_kept():
    gaps = Gaps(0, 0)
    for sequence in range(2, 2 * MAX_RANGES + 6, 2):
        gaps = gaps.arrived(sequence, sequence)
    assert len(gaps.ranges) == MAX_RANGES
    assert (gaps.ranges[0], gaps.ranges[-1]) == ((5, 5), (2003, 2003))
    assert gaps.may_contain(3)  # older gaps are forgotten


@st.composite
def any_rows(draw):
    count, n = draw(st.integers(0, 6)), draw(st.integers(1, 4))
    shapes = (count, *[(count, n)] * 4, count)
    elements = st.floats(width=64, allow_nan=True, allow_infinity=True)
    *values, weight = (draw(arrays(float, shape, elements=elements)) for shape in shapes)
    return Rows(*values, draw(arrays(np.uint8, count, elements=st.integers(0, len(CODES) - 1))), weight)


@given(any_rows())
def test_encoding_keeps_every_bit(given_rows):
    decoded = decode(encode(given_rows))
    for name in ARRAYS:
        found, expected = getattr(decoded, name), getattr(given_rows, name)
        assert (found.dtype, found.shape, found.tobytes()) == (expected.dtype, expected.shape, expected.tobytes())


def test_encoding_is_valid_safetensors():
    data = encode(make_rows(3))
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert {name: (entry["dtype"], entry["shape"]) for name, entry in header.items() if name != "__metadata__"} == {
        "time": ("F64", [3]),
        **dict.fromkeys(("q", "dq", "ddq", "tau"), ("F64", [3, 2])),
        "code": ("U8", [3]),
        "weight": ("F64", [3]),
    }


@pytest.mark.parametrize("length", [0, 7, 40, -1])
def test_truncated_rows_are_rejected(length):
    with pytest.raises(ValueError, match="cannot be read"):
        decode(encode(make_rows())[:length])
