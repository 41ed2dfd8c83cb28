"""Accelerations derived within a stream, independent of how it is cut into batches and ordered."""

from itertools import pairwise

import numpy as np
import pytest

from lipcore.online.acceleration import derive, window
from tests.service.learning.learning_models import RATE, max_difference
from tests.service.learning.recordings import (
    make_recording,
    make_request,
    predict_after_learning,
    read_codes,
    read_logged_rows,
    send_batch,
    slice_recording,
)

MAX_DIFFERENCE = 1e-8
HALF_WINDOW = window(RATE)
ROWS = 48
"""Too few to raise the floor of the stated uncertainty."""


def cut_batches(cuts, rows=None):
    """Return rows without accelerations, cut into batches."""
    rows = make_recording(samples=ROWS) if rows is None else rows
    edges = [0, *cuts, len(rows)]
    return [slice_recording(rows, a, b, without=("ddq",)) for a, b in pairwise(edges)]


def derive_whole_recording(rows=None):
    """Return the rows that have an acceleration, derived from the whole recording at once."""
    rows = make_recording(samples=ROWS) if rows is None else rows
    found = derive(rows.t, rows.dq, HALF_WINDOW)
    inner = slice_recording(rows, HALF_WINDOW, len(rows) - HALF_WINDOW)
    return {**inner, "ddq": found.ddq.tolist()}


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
def test_result_does_not_depend_on_batch_cuts_or_order(learning_service, request, cuts, order):
    parts = cut_batches(cuts)
    places = list(range(len(parts)))
    if order == "backward":
        places.reverse()
    elif order == "shuffled":
        np.random.default_rng(len(parts)).shuffle(places)
    learning_model = learning_service.create_model(f"cut-{request.node.callspec.id.replace(' ', '-')}")
    replies = [send_batch(learning_model, place, parts[place]) for place in places]
    assert sum(each["accepted"] for each in replies) == ROWS - 2 * HALF_WINDOW
    for each in replies:
        carried = each["derived"]["ddq"]["carried"]
        assert each["rows"] + carried == each["accepted"] + sum(each["rejected"].values())
    assert (
        max_difference(
            learning_model.wait_for_revision(len(parts)),
            predict_after_learning(learning_service, derive_whole_recording()),
        )
        < MAX_DIFFERENCE
    )


def test_missing_batches_and_pauses_leave_edges(learning_service):
    paused = learning_service.create_model("with-a-pause")
    first, second = cut_batches([30])
    send_batch(paused, 0, first)
    reply = send_batch(paused, 1, second | {"t": [value + 0.5 for value in second["t"]]})
    assert (reply["rejected"], reply["derived"]["ddq"]["carried"]) == ({"edge": 2 * HALF_WINDOW}, 0)
    learning_model = learning_service.create_model("with-a-hole")
    parts = cut_batches([20, 40])
    assert send_batch(learning_model, 0, parts[0])["rejected"] == {"edge": 2 * HALF_WINDOW}
    assert send_batch(learning_model, 2, parts[2])["rejected"] == {"edge": 2 * HALF_WINDOW}


@pytest.mark.parametrize(("name", "row", "code"), [("dq", [None, 0.1], "non_finite"), ("t", 0.0, "time_jump")])
def test_rows_without_velocity_or_time_make_neighbours_edges(learning_service, name, row, code):
    learning_model = learning_service.create_model(f"broken-{name}-{code.replace('_', '-')}")
    (body,) = cut_batches([])
    body[name][30] = row
    send_batch(learning_model, 0, body)
    expected = ["learnt"] * ROWS
    for place in (*range(HALF_WINDOW), *range(30 - HALF_WINDOW, 31 + HALF_WINDOW), *range(ROWS - HALF_WINDOW, ROWS)):
        expected[place] = "edge"
    expected[30] = code
    assert read_codes(learning_service, learning_model) == expected


def test_carried_rows_are_checked_once_acceleration_is_derived(learning_service, monkeypatch):
    """A velocity step between two batches: its velocities are possible, its acceleration is not."""
    observed = learning_service.service.learners._log
    monkeypatch.setattr(observed, "settings", observed.settings.model_copy(update={"max_acceleration": 100.0}))
    learning_model = learning_service.create_model("knock")
    parts = cut_batches([30])
    parts[1]["dq"][0] = [45.0, 0.0]
    assert "limit" not in send_batch(learning_model, 0, parts[0])["rejected"]
    reply = send_batch(learning_model, 1, parts[1])
    assert reply["rejected"]["limit"] > 0
    found = read_logged_rows(learning_service, learning_model)[1]
    beyond = np.abs(np.nan_to_num(found.ddq)).max(axis=1) > observed.settings.max_acceleration
    assert (found.code[beyond] != 0).all()
    assert beyond[:HALF_WINDOW].any()


def test_unlearnt_batches_carry_no_rows(learning_service):
    learning_model = learning_service.create_model("taken-out")
    parts = cut_batches([30])
    send_batch(learning_model, 0, parts[0])
    learning_model.delete("observations/arm/0")
    assert send_batch(learning_model, 1, parts[1])["derived"]["ddq"]["carried"] == 0


def test_derivation_window_stays_constant_in_a_stream(learning_service):
    """The estimated rate varies between batches; a varying window would learn rows twice or not at all."""
    rows = make_recording(samples=3 * ROWS, rate=104.0)
    assert window(104.0) != window(116.0)
    learning_model = learning_service.create_model("wavering")
    parts = cut_batches([ROWS, 2 * ROWS], rows)
    for each, stretch in zip(parts, (1.0, 1.12, 1.0), strict=True):
        begin = each["t"][0]
        each["t"] = [begin + (value - begin) / stretch for value in each["t"]]
    replies = [send_batch(learning_model, sequence, each) for sequence, each in enumerate(parts)]
    assert {each["derived"]["ddq"]["window"] for each in replies} == {window(104.0)}


@pytest.mark.parametrize("rate", [1.0, 40.0])
def test_slow_streams_are_rejected_with_found_and_required_rate(learning_service, rate):
    learning_model = learning_service.create_model(f"slow-{rate:g}")
    body = slice_recording(make_recording(samples=30, rate=rate), 0, 30, without=("ddq",))
    reply = learning_model.expect_error("POST", "observations", 422, "invalid_request", json=make_request(0, body))
    assert reply["detail"][0]["field"] == "ddq"
    assert f"{rate:g} rows per second" in reply["detail"][0]["value"]
    assert "at least 50 rows per second" in reply["detail"][0]["expected"]
    assert read_logged_rows(learning_service, learning_model) == []
    assert (
        send_batch(learning_model, 0, slice_recording(make_recording(samples=30, rate=rate), 0, 30))["accepted"] == 30
    )


@pytest.mark.parametrize(
    "times",
    [
        pytest.param([None, None, 0.3], id="one time"),
        pytest.param([0.0, 0.0, 0.0], id="standing still"),
        pytest.param([0.0, None, 0.01, None, 0.02], id="every other"),
        pytest.param([0.0, 0.01, 0.023, 0.04, 0.063, 0.093, 0.133], id="uneven"),
    ],
)
def test_times_without_a_rate_are_rejected(learning_service, request, times):
    learning_model = learning_service.create_model(f"no-rate-{request.node.callspec.id.replace(' ', '-')}")
    body = slice_recording(make_recording(), 0, len(times), without=("ddq",)) | {"t": times}
    reply = learning_model.expect_error("POST", "observations", 422, "invalid_request", json=make_request(0, body))
    assert reply["detail"][0]["field"] == "t"
    assert read_logged_rows(learning_service, learning_model) == []
