"""Frames of a stream: logged in order, once each, with the predictions that were sent."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from lipcore.data.independence import INDEPENDENT_HZ, stream_weights
from lipcore.online.record import Record
from service.contract.observations import ExpiredError
from service.foundation.errors import ConflictError
from service.journal import log
from service.learning.ingest.frames import Frames, FramesResult
from tests.service.learning.learning_models import LearningModel, LearningService
from tests.service.learning.recordings import (
    assert_learnt,
    make_recording,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)


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


@dataclass(frozen=True)
class FrameSender:
    """Sender of frames to a model."""

    service: LearningService
    model: LearningModel

    def make(self, sequences: Any, **more: Any) -> Frames:
        return make_frames(self.service, self.model, sequences, **more)

    def send(self, sequences: Any, **more: Any) -> FramesResult:
        return self.service.service.learners.observe_frames(self.make(sequences, **more))

    def read_rows(self) -> list[Any]:
        return read_logged_rows(self.service, self.model)

    def assert_learnt(self, sequences: Any, revision: int) -> None:
        """Check the prediction against that after learning these rows with the logged weights."""
        rows = {name: getattr(make_recording(), name)[list(sequences)] for name in ("q", "dq", "ddq", "tau")}
        weight = np.concatenate([each.learnt.weight for each in self.read_rows()])
        assert_learnt(self.service, self.model, revision, rows, weight)


@pytest.fixture
def frames(learning_service, learning_model):
    return FrameSender(learning_service, learning_model)


RESULTS = {
    "in order": [
        (range(10), FramesResult(9, 10, 0, {}, 1)),
        (range(10, 25), FramesResult(24, 15, 0, {}, 2)),
    ],
    "with gaps": [
        ([0, 1, 5, 9], FramesResult(9, 4, 0, {}, 1)),
        ([9, 12], FramesResult(12, 1, 1, {}, 2)),
        ([4], "frame 4 of stream 'socket' comes after one with a higher"),
        ([1, 5], FramesResult(5, 0, 2, {}, 1)),
    ],
    "twice in one message": [
        ([0, 1, 1, 2], "sequences must increase"),
        (range(3), FramesResult(2, 3, 0, {}, 1)),
    ],
    "repeated from within a batch to beyond the last": [
        (range(10), FramesResult(9, 10, 0, {}, 1)),
        (range(10, 20), FramesResult(19, 10, 0, {}, 2)),
        (range(5, 26), FramesResult(25, 6, 15, {}, 3)),
        (range(26), FramesResult(25, 0, 26, {}, 3)),
        (range(3), FramesResult(2, 0, 3, {}, 1)),
    ],
}
"""Sequences of frames sent together, and their results or the message of the conflict."""


@pytest.mark.parametrize("results", RESULTS.values(), ids=RESULTS)
def test_frames_are_logged_in_order_and_learnt_once(learning_service, frames, results):
    learnt, sizes = set(), []
    for sequences, expected in results:
        if isinstance(expected, str):
            with pytest.raises(ConflictError, match=expected):
                frames.send(sequences)
            continue
        assert frames.send(sequences) == expected
        if new := set(sequences) - learnt:
            event = frames.model.find_batch(min(new), "socket")
            assert (event.last_sequence, event.rows, event.learnt, event.version) == (max(new), len(new), len(new), 1)
            learnt |= new
            sizes.append(len(new))
    assert [len(rows) for rows in frames.read_rows()] == sizes
    frames.assert_learnt(sorted(learnt), revision=len(sizes))
    with learning_service.service.database.session() as session:
        assert log.stream(session, frames.model.name, "socket").kind == "frames"


def test_record_uses_the_predictions_sent_to_the_client(frames):
    given = frames.make(range(10))
    off = {"mean": given.mean + 0.01, "std": given.std * 1.5}
    frames.send(range(10), **off)
    record = Record.from_json(frames.model.find_batch(0, "socket").record)
    np.testing.assert_allclose(record.squared, ((given.tau - off["mean"]) ** 2).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(record.variance, (off["std"] ** 2).mean(axis=0), rtol=1e-12)


def test_frames_predicted_with_old_payload_are_judged_by_current_one(frames):
    """Frames may be predicted before a payload is detected, or with a payload that is removed."""
    given = frames.make(range(20))
    off = given.mean + 1000 * given.std
    assert frames.send(range(10), mean=off[:10]).rejected == {"contact": 10}
    assert frames.send(range(10, 20), mean=off[10:], loaded=True).accepted == 10
    event = frames.model.find_batch(10, "socket")
    record = Record.from_json(event.record)  # of the predictions that were sent
    np.testing.assert_allclose(record.squared, ((given.tau - off)[10:] ** 2).mean(axis=0), rtol=1e-12)
    assert max(event.report["surprise"]) < 20


@pytest.mark.parametrize("name", ["q", "tau"])
def test_reused_sequence_is_rejected_and_not_logged(frames, name):
    frames.send(range(10))
    other = getattr(frames.make(range(8, 14)), name).copy()
    other[1, 1] += 1e-9
    with pytest.raises(ConflictError, match=f"frame 9 of stream 'socket' was sent before with another {name}"):
        frames.send(range(8, 14), **{name: other})
    assert len(frames.read_rows()) == 1
    assert frames.send(range(8, 14)) == FramesResult(13, 4, 2, {}, 2)


def test_bad_frames_are_rejected_by_code_and_recognised_again(learning_service, learning_model, frames):
    given = frames.make(range(10))
    tau, dq, mean = given.tau.copy(), given.dq.copy(), given.mean.copy()
    tau[2, 1], dq[4], tau[7, 0], mean[8, 0] = np.nan, 0.0, 1e7, np.inf
    bad = {"tau": tau, "dq": dq, "mean": mean}
    expected = {"non_finite": 1, "stationary": 1, "limit": 2}
    assert frames.send(range(10), **bad) == FramesResult(9, 6, 0, expected, 1)
    codes = {2: "non_finite", 4: "stationary", 7: "limit", 8: "limit"}
    assert read_codes(learning_service, learning_model) == [codes.get(row, "learnt") for row in range(10)]
    assert frames.send(range(10), **bad) == FramesResult(9, 0, 10, {}, 1)
    frames.assert_learnt([0, 1, 3, 5, 6, 9], revision=1)


def test_stream_contains_frames_or_batches_only(learning_model, frames):
    body = slice_recording(make_recording(), 0, 3)
    frames.send(range(3))
    send_batch(learning_model, 0, body, "http")
    with pytest.raises(ConflictError, match="consists of batches, not frames"):
        frames.send(range(3), stream_id="http")
    sent = {"stream_id": "socket", "sequence": 9, **body}
    reply = learning_model.expect_error("POST", "observations", 409, "conflict", json=sent)
    assert "consists of frames, not batches" in reply["message"]


def test_expired_frames_are_not_accepted_again(frames):
    for first in (0, 5, 10):
        frames.send(range(first, first + 5))
    frames.model.delete_from_log(0, stream_id="socket")
    with pytest.raises(ExpiredError, match="whether batch 3 of stream"):
        frames.send([3])
    assert frames.send(range(5, 16)) == FramesResult(15, 1, 10, {}, 4)


def test_frame_weight_follows_time_since_previous_frame(frames):
    frames.send(range(10))
    (first,) = frames.read_rows()
    np.testing.assert_array_equal(first.weight, stream_weights(first.time))
    frames.send(range(10, 20), time=first.time[-1] + 0.02 + 1e-3 * np.arange(10))
    expected = INDEPENDENT_HZ * np.array([0.02, *[1e-3] * 9])
    np.testing.assert_allclose(frames.read_rows()[1].weight, expected, rtol=1e-3)
