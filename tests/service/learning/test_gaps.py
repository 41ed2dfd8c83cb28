"""Streams of observations: their kind and number, and which of their sequences have not come."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.foundation.errors import BusyError, ConflictError
from service.journal import log
from service.journal.log import Gaps
from tests.service.learning.batches import MODEL, OTHER, batch, live, opened, source, write


@pytest.fixture
def database(home):
    database = opened(home)
    yield database
    database.close()


def test_a_stream_keeps_its_kind_and_its_first_offset(database):
    write(database, batch(0, offset=12.5), batch(1, offset=99.0), batch(0, 4, stream_id="robot-2"))
    assert (source(database).kind, source(database).offset) == ("batches", 12.5)
    with pytest.raises(ConflictError, match="'robot-1' of model 'arm' carries batches, not frames: use another"):
        write(database, batch(2, 3))
    with pytest.raises(ConflictError, match="'robot-2' of model 'arm' carries frames, not batches"):
        write(database, batch(5, stream_id="robot-2"))
    assert live(database) == [1, 2, 3]


def test_frames_must_go_on(database):
    write(database, batch(0, 4), batch(7, 9))
    assert source(database).missing["ranges"] == [[5, 6]]
    for first in (5, 9):
        with pytest.raises(ConflictError, match=f"has come to frame 9, frame {first} does not go on from there"):
            write(database, batch(first, first + 1))


def test_the_number_of_streams_is_bounded_for_each_model(database):
    write(database, batch(0), batch(0, stream_id="robot-2"))
    write(database, batch(0), model=OTHER)
    with database.transaction() as session:
        log.append_batch(session, MODEL, batch(1), most_streams=2)
        with pytest.raises(BusyError, match="has 2 sources of observations, the most it may have"):
            log.append_batch(session, MODEL, batch(0, stream_id="robot-3"), most_streams=2)
        log.append_batch(session, OTHER, batch(0, stream_id="robot-3"), most_streams=2)
    assert source(database, "robot-3") is None


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
        assert [s for s in range(-1, 27) if known.may_hold(s)] == sorted(seen)


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 5)), min_size=1, max_size=10))
def test_the_gaps_of_ranges_are_right_even_where_they_overlap(spans):
    known = Gaps(spans[0][0], sum(spans[0]))
    seen = set()
    for first, more in spans:
        known = known.arrived(first, first + more)
        seen |= set(range(first, first + more + 1))
    assert (known.first, known.last, [list(pair) for pair in known.ranges]) == (min(seen), max(seen), misses(seen))


@settings(max_examples=15, deadline=None)
@given(SEQUENCES)
def test_streams_write_down_their_gaps(tmp_path_factory, sequences):
    database = opened(tmp_path_factory.mktemp("gaps"))
    write(database, *map(batch, sequences))
    known = source(database)
    assert (known.last, known.missing["ranges"]) == (max(sequences), misses(set(sequences)))
    database.close()


def test_only_the_newest_of_very_many_gaps_are_remembered():
    known = Gaps(0, 0)
    for sequence in range(2, 2 * log.MOST_RANGES + 6, 2):
        known = known.arrived(sequence, sequence)
    assert len(known.ranges) == log.MOST_RANGES
    assert (known.ranges[0], known.ranges[-1]) == ((5, 5), (2003, 2003))
    assert known.may_hold(3)  # it may have, for all that is known


def test_a_batch_that_may_have_been_learnt_and_deleted_is_refused_but_one_that_never_came_is_not(database):
    write(database, batch(2), batch(5))
    with database.transaction() as session:
        log.stream(session, MODEL, "robot-1").forgotten = 4
    assert [log.is_forgotten(source(database), s) for s in (1, 2, 3, 4, 5, 6)] == [False, True] + [False] * 4
    with pytest.raises(ConflictError, match="batch 2 of stream 'robot-1' of model 'arm' may have come before"):
        write(database, batch(2))
    assert write(database, batch(3), batch(1)) == [3, 4]
