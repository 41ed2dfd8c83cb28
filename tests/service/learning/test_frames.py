"""Frames of a stream: logged in order, once each, with the predictions that were sent."""

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
from tests.service.learning.learning_models import max_difference
from tests.service.learning.recordings import (
    make_recording,
    predict_after_learning,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)

MAX_DIFFERENCE = 1e-8


def make_frames(
    learning_service: Any, learning_model: Any, sequences: Any, stream_id: str = "socket", **changes: Any
) -> Frames:
    """Return frames with the rows of a recording at these sequences, as a connection passes them on."""
    rows, places = make_recording(), np.array(list(sequences))
    served = learning_service.service.loaded.get(learning_model.name, None)
    given = {name: getattr(rows, name)[places] for name in ("q", "dq", "ddq", "tau")}
    answer = served.model.predict(given["q"], given["dq"], given["ddq"])
    now = time.time() + 1e-3 * np.arange(len(places))
    fields = {"time": now, **given, "mean": answer.tau, "std": answer.tau_std, **changes}
    return Frames(learning_model.name, stream_id, served, places, **fields)


@pytest.fixture
def observe_frames(learning_service, learning_model):
    def send_frames(sequences: Any, **more: Any) -> FramesResult:
        return learning_service.service.learners.observe_frames(
            make_frames(learning_service, learning_model, sequences, **more)
        )

    return send_frames


def test_frames_are_logged_together_and_learnt(learning_service, learning_model, observe_frames):
    assert observe_frames(range(10)) == FramesResult(9, 10, 0, {}, 1)
    assert observe_frames(range(10, 25)) == FramesResult(24, 15, 0, {}, 2)
    assert [len(rows) for rows in read_logged_rows(learning_service, learning_model)] == [10, 15]
    assert (
        max_difference(
            learning_model.wait_for_revision(2),
            predict_after_learning(
                learning_service,
                slice_recording(make_recording(), 0, 25),
                _read_weights(learning_service, learning_model),
            ),
        )
        < MAX_DIFFERENCE
    )
    with learning_service.service.database.session() as session:
        event = log.find_batch(session, learning_model.name, "socket", 10)
        assert (event.last_sequence, event.rows, event.learnt, event.version) == (24, 15, 15, 1)
        assert log.stream(session, learning_model.name, "socket").kind == "frames"


def test_record_uses_the_predictions_sent_to_the_client(learning_service, learning_model, observe_frames):
    given = make_frames(learning_service, learning_model, range(10))
    off = {"mean": given.mean + 0.01, "std": given.std * 1.5}
    observe_frames(range(10), **off)
    with learning_service.service.database.session() as session:
        record = Record.from_json(log.find_batch(session, learning_model.name, "socket", 0).record)
    error = given.tau - off["mean"]
    np.testing.assert_allclose(record.squared, (error**2).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(record.variance, (off["std"] ** 2).mean(axis=0), rtol=1e-12)


def test_frames_predicted_with_old_payload_are_judged_by_current_one(learning_service, learning_model, observe_frames):
    """Frames may be predicted before a payload is detected, or with a payload that is removed."""
    given = make_frames(learning_service, learning_model, range(20))
    off = given.mean + 1000 * given.std
    assert observe_frames(range(10), mean=off[:10]).rejected == {"contact": 10}
    assert observe_frames(range(10, 20), mean=off[10:], loaded=True).accepted == 10
    with learning_service.service.database.session() as session:
        event = log.find_batch(session, learning_model.name, "socket", 10)
    record = Record.from_json(event.record)  # of the predictions that were sent
    np.testing.assert_allclose(record.squared, ((given.tau - off)[10:] ** 2).mean(axis=0), rtol=1e-12)
    assert max(event.report["surprise"]) < 20


def test_sequences_may_have_gaps(learning_service, learning_model, observe_frames):
    assert observe_frames([0, 1, 5, 9]) == FramesResult(9, 4, 0, {}, 1)
    assert observe_frames([9, 12]) == FramesResult(12, 1, 1, {}, 2)
    assert observe_frames([1, 5]) == FramesResult(5, 0, 2, {}, 1)
    assert (
        max_difference(
            learning_model.wait_for_revision(2),
            predict_after_learning(
                learning_service, _select_rows([0, 1, 5, 9, 12]), _read_weights(learning_service, learning_model)
            ),
        )
        < MAX_DIFFERENCE
    )


def test_skipped_frames_are_rejected_later(learning_service, learning_model, observe_frames):
    observe_frames([0, 1, 5, 9])
    observe_frames([11])
    with pytest.raises(ConflictError, match="frame 4 of stream 'socket' comes after one with a higher"):
        observe_frames([4])
    assert len(read_logged_rows(learning_service, learning_model)) == 2


def test_repeated_frames_are_learnt_once(learning_service, learning_model, observe_frames):
    observe_frames(range(10))
    observe_frames(range(10, 20))
    # other boundaries than the first time: from within the first batch to beyond the last
    assert observe_frames(range(5, 26)) == FramesResult(25, 6, 15, {}, 3)
    assert observe_frames(range(26)) == FramesResult(25, 0, 26, {}, 3)
    assert observe_frames(range(3)) == FramesResult(2, 0, 3, {}, 1)
    assert [len(rows) for rows in read_logged_rows(learning_service, learning_model)] == [10, 10, 6]
    assert (
        max_difference(
            learning_model.wait_for_revision(3),
            predict_after_learning(
                learning_service,
                slice_recording(make_recording(), 0, 26),
                _read_weights(learning_service, learning_model),
            ),
        )
        < MAX_DIFFERENCE
    )


@pytest.mark.parametrize("name", ["q", "tau"])
def test_reused_sequence_is_rejected_and_not_logged(learning_service, learning_model, observe_frames, name):
    observe_frames(range(10))
    other = getattr(make_frames(learning_service, learning_model, range(8, 14)), name).copy()
    other[1, 1] += 1e-9
    with pytest.raises(ConflictError, match=f"frame 9 of stream 'socket' was sent before with another {name}"):
        observe_frames(range(8, 14), **{name: other})
    assert len(read_logged_rows(learning_service, learning_model)) == 1
    assert observe_frames(range(8, 14)) == FramesResult(13, 4, 2, {}, 2)


def test_bad_frames_are_rejected_by_code_and_recognised_again(learning_service, learning_model, observe_frames):
    given = make_frames(learning_service, learning_model, range(10))
    tau, dq, mean = given.tau.copy(), given.dq.copy(), given.mean.copy()
    tau[2, 1], dq[4], tau[7, 0], mean[8, 0] = np.nan, 0.0, 1e7, np.inf
    bad = {"tau": tau, "dq": dq, "mean": mean}
    expected = {"non_finite": 1, "stationary": 1, "limit": 2}
    assert observe_frames(range(10), **bad) == FramesResult(9, 6, 0, expected, 1)
    assert read_codes(learning_service, learning_model)[2::1][:6] == [
        "non_finite",
        "learnt",
        "stationary",
        "learnt",
        "learnt",
        "limit",
    ]
    assert observe_frames(range(10), **bad) == FramesResult(9, 0, 10, {}, 1)
    assert (
        max_difference(
            learning_model.wait_for_revision(1),
            predict_after_learning(
                learning_service, _select_rows([0, 1, 3, 5, 6, 9]), _read_weights(learning_service, learning_model)
            ),
        )
        < MAX_DIFFERENCE
    )


def test_sequences_must_increase(learning_service, learning_model, observe_frames):
    with pytest.raises(ConflictError, match="sequences must increase"):
        observe_frames([0, 1, 1, 2])
    assert read_logged_rows(learning_service, learning_model) == []


def test_stream_contains_frames_or_batches_only(learning_service, learning_model, observe_frames):
    observe_frames(range(3))
    send_batch(learning_model, 0, slice_recording(make_recording(), 0, 3), "http")
    with pytest.raises(ConflictError, match="consists of batches, not frames"):
        observe_frames(range(3), stream_id="http")
    body = {"stream_id": "socket", "sequence": 9, **slice_recording(make_recording(), 0, 3)}
    reply = learning_model.expect_error("POST", "observations", 409, "conflict", json=body)
    assert "consists of frames, not batches" in reply["message"]


def test_expired_frames_are_not_accepted_again(learning_service, learning_model, observe_frames):
    for first in (0, 5, 10):
        observe_frames(range(first, first + 5))
    with learning_service.service.database.transaction() as session:
        event = log.find_batch(session, learning_model.name, "socket", 0)
        snapshots._note_forgotten(session, event)
        session.delete(event)
    with pytest.raises(ExpiredError, match="whether batch 3 of stream"):
        observe_frames([3])
    assert observe_frames(range(5, 16)) == FramesResult(15, 1, 10, {}, 4)


def _select_rows(places):
    return {name: getattr(make_recording(), name)[places].tolist() for name in ("q", "dq", "ddq", "tau")}


def _read_weights(learning_service, learning_model):
    """Return the logged weights of the learnt rows."""
    return np.concatenate([rows.learnt.weight for rows in read_logged_rows(learning_service, learning_model)])


def test_frame_weight_follows_time_since_previous_frame(learning_service, learning_model, observe_frames):
    observe_frames(range(10))
    (first,) = read_logged_rows(learning_service, learning_model)
    np.testing.assert_array_equal(first.weight, stream_weights(first.time))
    observe_frames(range(10, 20), time=first.time[-1] + 0.02 + 1e-3 * np.arange(10))
    second = read_logged_rows(learning_service, learning_model)[1]
    expected = INDEPENDENT_HZ * np.array([0.02, *[1e-3] * 9])
    np.testing.assert_allclose(second.weight, expected, rtol=1e-3)
