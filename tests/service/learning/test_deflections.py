"""Deflections of a stream's play elements: a function of its log, whatever its rows are worth to the model."""

from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy

from lipcore.kernels.drive.play import MAX_GAP_S, PlayState, element_widths
from lipcore.online.batch import ARRAYS, Rows
from lipcore.online.stream import StreamRecord
from lipcore.vocabulary import CODES
from service.journal import log
from tests.service.learning.batches import make_rows
from tests.service.learning.recordings import make_recording, read_logged_rows, send_batch, slice_recording
from tests.system.remembering import save_model

WIDTHS = element_widths(("revolute", "revolute"))
BATCH = 20


@pytest.fixture
def learning_model(learning_service, tmp_path):
    """Model with play elements."""
    return replace(learning_service, trained=save_model(tmp_path / "remembering")).create_model()


def follow_slowly(q):
    """Return deflections by the rule of a backlash, z ← clip(z, q − r, q + r), from both ends: (N, 2 K, n)."""
    ends = []
    for end in (-1.0, 1.0):
        z, found = q[0] - end * WIDTHS, []
        for now in q:
            z = np.clip(z, now - WIDTHS, now + WIDTHS)
            found.append((now - z) / WIDTHS)
        ends.append(np.array(found))
    return np.concatenate([0.5 * (ends[0] + ends[1]), 0.5 * (ends[1] - ends[0])], axis=1)


def assert_follow(rows, expected):
    assert rows.deflections is not None
    np.testing.assert_allclose(rows.deflections, expected, atol=1e-9)


def read_batch(learning_service, learning_model, number):
    return read_logged_rows(learning_service, learning_model)[number]


def test_deflections_follow_all_rows_of_a_stream_learnt_or_not(learning_service, learning_model):
    recorded = make_recording(samples=4 * BATCH)
    wrong = (np.arange(4 * BATCH) >= 10) & (np.arange(4 * BATCH) < 25)
    recorded = replace(recorded, tau=np.where(wrong[:, None], 1e9, recorded.tau))
    for number in range(4):
        send_batch(learning_model, number, slice_recording(recorded, BATCH * number, BATCH * (number + 1)))
    logged = read_logged_rows(learning_service, learning_model)
    assert CODES.index("limit") in logged[0].code
    assert_follow(Rows.concatenate(logged), follow_slowly(recorded.q))


def test_rows_that_wait_for_the_next_batch_keep_their_deflections(learning_service, learning_model):
    recorded = make_recording(samples=4 * BATCH)
    for number in range(4):
        part = slice_recording(recorded, BATCH * number, BATCH * (number + 1), without=("ddq",))
        send_batch(learning_model, number, part)
    expected, start = follow_slowly(recorded.q), 0
    for number, rows in enumerate(read_logged_rows(learning_service, learning_model)):
        carried = len(rows) - BATCH  # rows of the batch before
        start = BATCH * number - carried
        assert (carried > 0) == (number > 0)
        assert_follow(rows, expected[start : BATCH * (number + 1)])


def test_late_batch_begins_unknown_and_changes_nothing_after_it(learning_service, learning_model):
    recorded = make_recording(samples=4 * BATCH)
    parts = [slice_recording(recorded, BATCH * number, BATCH * (number + 1)) for number in range(4)]
    for number in (0, 2, 1, 3):
        send_batch(learning_model, number, parts[number])
    first, third, late, last = read_logged_rows(learning_service, learning_model)
    assert_follow(late, follow_slowly(recorded.q[BATCH : 2 * BATCH]))
    after = np.concatenate([recorded.q[:BATCH], recorded.q[2 * BATCH :]])
    assert_follow(Rows.concatenate([first, third, last]), follow_slowly(after))


def test_each_stream_has_its_own_deflections(learning_service, learning_model):
    recorded = make_recording(samples=2 * BATCH)
    send_batch(learning_model, 0, slice_recording(recorded, 0, BATCH))
    send_batch(learning_model, 0, slice_recording(recorded, BATCH, 2 * BATCH), stream_id="other")
    assert_follow(read_batch(learning_service, learning_model, 1), follow_slowly(recorded.q[BATCH:]))


def test_rows_of_a_model_that_remembers_nothing_can_be_read_by_earlier_releases(learning_service):
    learning_model = learning_service.create_model()
    send_batch(learning_model, 0, slice_recording(make_recording(samples=BATCH), 0, BATCH))
    rows = read_batch(learning_service, learning_model, 0)
    assert rows.deflections is None
    assert sorted(safetensors.numpy.load(log.encode(rows))) == sorted(ARRAYS)


def test_state_survives_a_restart():
    rows = replace(make_rows(), deflections=None)
    followed, state = rows.followed(PlayState.unknown(2), WIDTHS)
    record = StreamRecord.from_json(StreamRecord(play=state).to_json(), 0.0)
    assert record.play is not None
    assert np.array_equal(record.play.packed, state.packed)
    earlier = {name: value for name, value in StreamRecord().to_json().items() if name != "play"}
    assert StreamRecord.from_json(earlier, 0.0).play is None
    assert followed.deflections is not None


@pytest.mark.parametrize("chosen", [slice(None), slice(3, None), slice(None, None, 2)], ids=["all", "last", "some"])
def test_logged_deflections_are_read_back_to_the_last_bit(chosen):
    rng = np.random.default_rng(2)
    time = np.arange(40) / 100
    q = 0.1 * np.sin(5 * time[:, None] + rng.uniform(0, 6, 2))
    dq = 0.5 * np.cos(5 * time[:, None] + np.zeros(2))
    rows = Rows(time, q, dq, dq, dq, np.zeros(40, np.uint8))
    rows.q[5] = np.nan
    rows.time[20:] += 2 * MAX_GAP_S
    taken = rows.followed(PlayState.unknown(2), WIDTHS)[0].take(chosen)
    again = log.decode(log.encode(taken))
    assert taken.deflections is not None
    assert np.array_equal(again.deflections, taken.deflections)
    assert np.array_equal(again.widths, WIDTHS)


def test_rows_of_earlier_releases_have_no_deflections():
    assert log.decode(log.encode(make_rows())).deflections is None
