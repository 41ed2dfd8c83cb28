"""Accelerations derived within a stream, independent of how it is cut into batches and ordered."""

from itertools import pairwise

import numpy as np
import pytest

from lipcore.online.acceleration import derive, window
from service.cli.verify import verify_home
from tests.service.learning.learning_models import RATE
from tests.service.learning.recordings import (
    assert_learnt,
    expect_rejection,
    make_recording,
    make_request,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)

HALF_WINDOW = window(RATE)
ROWS = 48
"""Too few to raise the floor of the stated uncertainty."""


def cut_batches(cuts, rows=None):
    """Return rows without accelerations, cut into batches."""
    rows = make_recording(samples=ROWS) if rows is None else rows
    return [slice_recording(rows, a, b, without=("ddq",)) for a, b in pairwise([0, *cuts, len(rows)])]


def derive_whole_recording():
    """Return the rows that have an acceleration, derived from the whole recording at once."""
    rows = make_recording(samples=ROWS)
    inner = slice_recording(rows, HALF_WINDOW, len(rows) - HALF_WINDOW)
    return {**inner, "ddq": derive(rows.t, rows.dq, HALF_WINDOW).ddq.tolist()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "cuts",
    [
        pytest.param([], id="one"),
        pytest.param([30], id="two"),
        pytest.param(range(5, 48, 5), id="smaller than the window"),
        pytest.param([2, 30, 33, 36], id="of any size"),
    ],
)
@pytest.mark.each_once
@pytest.mark.parametrize("order", ["forward", "backward", "shuffled"])
def test_result_does_not_depend_on_batch_cuts_or_order(learning_service, learning_model, cuts, order):
    parts = cut_batches(cuts)
    places = np.arange(len(parts))
    shuffled = np.random.default_rng(len(parts)).permutation(places)
    places = {"forward": places, "backward": places[::-1], "shuffled": shuffled}[order].tolist()
    replies = [send_batch(learning_model, place, parts[place]) for place in places]
    assert sum(each["accepted"] for each in replies) == ROWS - 2 * HALF_WINDOW
    for each in replies:
        carried = each["derived"]["ddq"]["carried"]
        assert each["rows"] + carried == each["accepted"] + sum(each["rejected"].values())
    assert_learnt(learning_service, learning_model, len(parts), derive_whole_recording())


@pytest.mark.parametrize("sequence", [1, 2], ids=["pause", "missing batch"])
def test_pauses_and_missing_batches_leave_edges(learning_model, sequence):
    first, _, third = cut_batches([20, 38])
    for number, body in ((0, first), (sequence, third)):
        reply = send_batch(learning_model, number, body)
        assert (reply["rejected"], reply["derived"]["ddq"]["carried"]) == ({"edge": 2 * HALF_WINDOW}, 0)


@pytest.mark.parametrize(("name", "row", "code"), [("dq", [None, 0.1], "non_finite"), ("t", 0.0, "time_jump")])
def test_rows_without_velocity_or_time_make_neighbours_edges(learning_service, learning_model, name, row, code):
    (body,) = cut_batches([])
    body[name][30] = row
    send_batch(learning_model, 0, body)
    expected = ["learnt"] * ROWS
    for place in (*range(HALF_WINDOW), *range(30 - HALF_WINDOW, 31 + HALF_WINDOW), *range(ROWS - HALF_WINDOW, ROWS)):
        expected[place] = "edge"
    expected[30] = code
    assert read_codes(learning_service, learning_model) == expected


def test_carried_rows_are_checked_once_acceleration_is_derived(learning_service, learning_model, monkeypatch):
    """A velocity step between two batches: its velocities are possible, its acceleration is not."""
    observed = learning_service.service.learners._log
    monkeypatch.setattr(observed, "settings", observed.settings.model_copy(update={"max_acceleration": 100.0}))
    first, second = cut_batches([30])
    second["dq"][0] = [45.0, 0.0]
    assert "limit" not in send_batch(learning_model, 0, first)["rejected"]
    assert send_batch(learning_model, 1, second)["rejected"]["limit"] > 0
    found = read_logged_rows(learning_service, learning_model)[1]
    beyond = np.abs(np.nan_to_num(found.ddq)).max(axis=1) > observed.settings.max_acceleration
    assert (found.code[beyond] != 0).all()
    assert beyond[:HALF_WINDOW].any()


def test_edge_rows_are_learnt_with_the_next_batch(learning_model):
    first, second = (send_batch(learning_model, number, part) for number, part in enumerate(cut_batches([30])))
    assert (first["accepted"], first["rejected"]) == (30 - 2 * HALF_WINDOW, {"edge": 2 * HALF_WINDOW})
    assert (second["accepted"], second["rejected"]) == (ROWS - 30, {"edge": HALF_WINDOW})
    assert second["derived"]["ddq"]["carried"] == HALF_WINDOW


def test_verify_accepts_batches_logged_with_rows_of_their_neighbours(learning_service, learning_model):
    for number, part in enumerate(cut_batches([20, 34])):
        send_batch(learning_model, number, part)
    logged = [len(rows) for rows in read_logged_rows(learning_service, learning_model)]
    assert logged == [20, 14 + HALF_WINDOW, ROWS - 34 + HALF_WINDOW]
    found = verify_home(learning_service.client.app.state.storage.settings)
    assert [each for each in found.damages if repr(learning_model.name) in each.name] == []


def test_unlearnt_batches_carry_no_rows(learning_model):
    first, second = cut_batches([30])
    send_batch(learning_model, 0, first)
    learning_model.delete("observations/arm/0")
    assert send_batch(learning_model, 1, second)["derived"]["ddq"]["carried"] == 0


def test_derivation_window_stays_constant_in_a_stream(learning_model):
    """The estimated rate varies between batches; a varying window would learn rows twice or not at all."""
    assert window(104.0) != window(116.0)
    parts = cut_batches([ROWS, 2 * ROWS], make_recording(samples=3 * ROWS, rate=104.0))
    for each, stretch in zip(parts, (1.0, 1.12, 1.0), strict=True):
        begin = each["t"][0]
        each["t"] = [begin + (value - begin) / stretch for value in each["t"]]
    replies = [send_batch(learning_model, sequence, each) for sequence, each in enumerate(parts)]
    assert {each["derived"]["ddq"]["window"] for each in replies} == {window(104.0)}


REQUIRED_RATE = "accelerations, or at least 50 rows per second"
UNDERIVABLE_TIMES = {
    "one time": ([None, None, 0.3], {"field": "t"}, 1),
    "standing still": ([0.0, 0.0, 0.0], {"field": "t"}, 1),
    "every other": ([0.0, None, 0.01, None, 0.02], {"field": "t"}, 3),
    "uneven": ([0.0, 0.01, 0.023, 0.04, 0.063, 0.093, 0.133], {"field": "t"}, 7),
    **{
        f"{rate} Hz": (
            [row / rate for row in range(30)],
            {"field": "ddq", "value": f"missing, with {rate} rows per second", "expected": REQUIRED_RATE},
            30,
        )
        for rate in (1, 40)
    },
}
"""Times, the detail of the error, and the number of rows that are accepted with accelerations."""


@pytest.mark.parametrize(("times", "detail", "accepted"), UNDERIVABLE_TIMES.values(), ids=UNDERIVABLE_TIMES)
def test_times_without_a_sufficient_rate_require_accelerations(
    learning_service, learning_model, times, detail, accepted
):
    body = slice_recording(make_recording(), 0, len(times)) | {"t": times}
    (item,) = expect_rejection(learning_model, make_request(0, body, ddq=None))["detail"]
    assert item | detail == item
    assert read_logged_rows(learning_service, learning_model) == []
    assert send_batch(learning_model, 0, body)["accepted"] == accepted
