"""Frames of a stream as the log takes them: in order, each once, with the answers that were given."""

import time
from typing import Any

import numpy as np
import pytest

from lipcore.data.independence import INDEPENDENT_HZ, stream_weights
from lipcore.online.record import Record
from service.contract.observations import ExpiredError
from service.foundation.errors import ConflictError
from service.journal import log, snapshots
from service.learning.ingest.frames import Frames, FramesResult
from tests.service.learning.lessons import apart
from tests.service.learning.recordings import codes, learnt_from, logged, part, recording, send

EXACT = 1e-8


def frames(school: Any, pupil: Any, sequences: Any, stream_id: str = "socket", **changes: Any) -> Frames:
    """Frames whose rows are those of a recording at their sequences, as a connection hands them over."""
    rows, places = recording(), np.array(list(sequences))
    served = school.service.loaded.get(pupil.model, None)
    given = {name: getattr(rows, name)[places] for name in ("q", "dq", "ddq", "tau")}
    answer = served.model.predict(given["q"], given["dq"], given["ddq"])
    now = time.time() + 1e-3 * np.arange(len(places))
    whole = {"time": now, **given, "mean": answer.tau, "std": answer.tau_std, **changes}
    return Frames(pupil.model, stream_id, served, places, **whole)


@pytest.fixture
def observe(school, pupil):
    def send_frames(sequences: Any, **more: Any) -> FramesResult:
        return school.service.learners.observe_frames(frames(school, pupil, sequences, **more))

    return send_frames


def test_frames_are_logged_together_and_learnt(school, pupil, observe):
    assert observe(range(10)) == FramesResult(9, 10, 0, {}, 1)
    assert observe(range(10, 25)) == FramesResult(24, 15, 0, {}, 2)
    assert [len(rows) for rows in logged(school, pupil)] == [10, 15]
    assert apart(pupil.settled(2), learnt_from(school, part(recording(), 0, 25), _weights(school, pupil))) < EXACT
    with school.service.database.session() as session:
        event = log.find_batch(session, pupil.model, "socket", 10)
        assert (event.last_sequence, event.rows, event.learnt, event.version) == (24, 15, 15, 1)
        assert log.stream(session, pupil.model, "socket").kind == "frames"


def test_the_record_is_that_of_the_answers_that_were_given(school, pupil, observe):
    given = frames(school, pupil, range(10))
    off = {"mean": given.mean + 0.01, "std": given.std * 1.5}
    observe(range(10), **off)
    with school.service.database.session() as session:
        record = Record.from_json(log.find_batch(session, pupil.model, "socket", 0).record)
    error = given.tau - off["mean"]
    np.testing.assert_allclose(record.squared, (error**2).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(record.variance, (off["std"] ** 2).mean(axis=0), rtol=1e-12)


def test_frames_that_were_answered_with_another_load_are_judged_by_what_is_known_now(school, pupil, observe):
    """A payload is noticed while frames wait that were answered without it, or answered with one that is gone."""
    given = frames(school, pupil, range(20))
    off = given.mean + 1000 * given.std
    assert observe(range(10), mean=off[:10]).rejected == {"contact": 10}
    assert observe(range(10, 20), mean=off[10:], loaded=True).accepted == 10
    with school.service.database.session() as session:
        event = log.find_batch(session, pupil.model, "socket", 10)
    record = Record.from_json(event.record)  # of the answers that were given
    np.testing.assert_allclose(record.squared, ((given.tau - off)[10:] ** 2).mean(axis=0), rtol=1e-12)
    assert max(event.report["surprise"]) < 20


def test_sequences_may_leave_gaps(school, pupil, observe):
    assert observe([0, 1, 5, 9]) == FramesResult(9, 4, 0, {}, 1)
    assert observe([9, 12]) == FramesResult(12, 1, 1, {}, 2)
    assert observe([1, 5]) == FramesResult(5, 0, 2, {}, 1)
    assert apart(pupil.settled(2), learnt_from(school, _picked([0, 1, 5, 9, 12]), _weights(school, pupil))) < EXACT


def test_a_frame_that_was_skipped_cannot_come_later(school, pupil, observe):
    observe([0, 1, 5, 9])
    observe([11])
    with pytest.raises(ConflictError, match="frame 4 of stream 'socket' comes after one of a higher"):
        observe([4])
    assert len(logged(school, pupil)) == 2


def test_frames_that_are_repeated_after_a_lost_connection_are_applied_once(school, pupil, observe):
    observe(range(10))
    observe(range(10, 20))
    # cut otherwise than the first time, from before the first batch's end to beyond the last
    assert observe(range(5, 26)) == FramesResult(25, 6, 15, {}, 3)
    assert observe(range(26)) == FramesResult(25, 0, 26, {}, 3)
    assert observe(range(3)) == FramesResult(2, 0, 3, {}, 1)
    assert [len(rows) for rows in logged(school, pupil)] == [10, 10, 6]
    assert apart(pupil.settled(3), learnt_from(school, part(recording(), 0, 26), _weights(school, pupil))) < EXACT


@pytest.mark.parametrize("name", ["q", "tau"])
def test_a_sequence_used_for_another_frame_is_refused_and_nothing_is_logged(school, pupil, observe, name):
    observe(range(10))
    other = getattr(frames(school, pupil, range(8, 14)), name).copy()
    other[1, 1] += 1e-9
    with pytest.raises(ConflictError, match=f"frame 9 of stream 'socket' has come before with another {name}"):
        observe(range(8, 14), **{name: other})
    assert len(logged(school, pupil)) == 1
    assert observe(range(8, 14)) == FramesResult(13, 4, 2, {}, 2)


def test_bad_frames_are_kept_out_by_code_and_known_again(school, pupil, observe):
    given = frames(school, pupil, range(10))
    tau, dq, mean = given.tau.copy(), given.dq.copy(), given.mean.copy()
    tau[2, 1], dq[4], tau[7, 0], mean[8, 0] = np.nan, 0.0, 1e7, np.inf
    bad = {"tau": tau, "dq": dq, "mean": mean}
    expected = {"non_finite": 1, "stationary": 1, "limit": 2}
    assert observe(range(10), **bad) == FramesResult(9, 6, 0, expected, 1)
    assert codes(school, pupil)[2::1][:6] == ["non_finite", "learnt", "stationary", "learnt", "learnt", "limit"]
    assert observe(range(10), **bad) == FramesResult(9, 0, 10, {}, 1)
    assert apart(pupil.settled(1), learnt_from(school, _picked([0, 1, 3, 5, 6, 9]), _weights(school, pupil))) < EXACT


def test_sequences_rise(school, pupil, observe):
    with pytest.raises(ConflictError, match="sequences must rise"):
        observe([0, 1, 1, 2])
    assert logged(school, pupil) == []


def test_a_stream_carries_frames_or_batches(school, pupil, observe):
    observe(range(3))
    send(pupil, 0, part(recording(), 0, 3), "http")
    with pytest.raises(ConflictError, match="carries batches, not frames"):
        observe(range(3), stream_id="http")
    body = {"stream_id": "socket", "sequence": 9, **part(recording(), 0, 3)}
    said = pupil.refused("POST", "observations", 409, "conflict", json=body)
    assert "carries frames, not batches" in said["message"]


def test_frames_that_are_no_longer_kept_are_not_taken_for_new(school, pupil, observe):
    for first in (0, 5, 10):
        observe(range(first, first + 5))
    with school.service.database.transaction() as session:
        event = log.find_batch(session, pupil.model, "socket", 0)
        snapshots._note_forgotten(session, event)
        session.delete(event)
    with pytest.raises(ExpiredError, match="whether batch 3 of stream"):
        observe([3])
    assert observe(range(5, 16)) == FramesResult(15, 1, 10, {}, 4)


def _picked(places):
    return {name: getattr(recording(), name)[places].tolist() for name in ("q", "dq", "ddq", "tau")}


def _weights(school, pupil):
    """Weights of the rows that teach, as they are logged."""
    return np.concatenate([rows.learnt.weight for rows in logged(school, pupil)])


def test_frames_count_for_the_time_since_the_frame_before(school, pupil, observe):
    observe(range(10))
    (first,) = logged(school, pupil)
    np.testing.assert_array_equal(first.weight, stream_weights(first.time))
    observe(range(10, 20), time=first.time[-1] + 0.02 + 1e-3 * np.arange(10))
    second = logged(school, pupil)[1]
    expected = INDEPENDENT_HZ * np.array([0.02, *[1e-3] * 9])
    np.testing.assert_allclose(second.weight, expected, rtol=1e-3)
