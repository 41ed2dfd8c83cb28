"""Accelerations that are derived within a stream: as if it had come in one piece, however it is cut and ordered."""

from itertools import pairwise

import numpy as np
import pytest

from lipcore.online.acceleration import derive, window
from tests.service.learning.lessons import RATE, apart
from tests.service.learning.recordings import batch, codes, learnt_from, logged, part, recording, send

EXACT = 1e-8
HALF = window(RATE)
ROWS = 48
"""So few that the stated uncertainty is not yet held against the errors seen."""


def pieces(cuts, rows=None):
    """Rows without accelerations, cut into batches."""
    rows = recording(samples=ROWS) if rows is None else rows
    edges = [0, *cuts, len(rows)]
    return [part(rows, a, b, without=("ddq",)) for a, b in pairwise(edges)]


def all_at_once(rows=None):
    """What the rows that have an acceleration teach, derived from the whole recording at once."""
    rows = recording(samples=ROWS) if rows is None else rows
    found = derive(rows.t, rows.dq, HALF)
    inner = part(rows, HALF, len(rows) - HALF)
    return {**inner, "ddq": found.ddq.tolist()}


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
def test_a_stream_teaches_the_same_however_it_is_cut_and_ordered(school, request, cuts, order):
    parts = pieces(cuts)
    places = list(range(len(parts)))
    if order == "backward":
        places.reverse()
    elif order == "shuffled":
        np.random.default_rng(len(parts)).shuffle(places)
    pupil = school.enrol(f"cut-{request.node.callspec.id.replace(' ', '-')}")
    said = [send(pupil, place, parts[place]) for place in places]
    assert sum(each["accepted"] for each in said) == ROWS - 2 * HALF
    for each in said:
        carried = each["derived"]["ddq"]["carried"]
        assert each["rows"] + carried == each["accepted"] + sum(each["rejected"].values())
    assert apart(pupil.settled(len(parts)), learnt_from(school, all_at_once())) < EXACT


def test_a_missing_batch_or_a_pause_leaves_edges(school):
    paused = school.enrol("with-a-pause")
    first, second = pieces([30])
    send(paused, 0, first)
    said = send(paused, 1, second | {"t": [value + 0.5 for value in second["t"]]})
    assert (said["rejected"], said["derived"]["ddq"]["carried"]) == ({"edge": 2 * HALF}, 0)
    pupil = school.enrol("with-a-hole")
    parts = pieces([20, 40])
    assert send(pupil, 0, parts[0])["rejected"] == {"edge": 2 * HALF}
    assert send(pupil, 2, parts[2])["rejected"] == {"edge": 2 * HALF}


@pytest.mark.parametrize(("name", "row", "code"), [("dq", [None, 0.1], "non_finite"), ("t", 0.0, "time_jump")])
def test_a_row_without_velocity_or_time_takes_its_neighbours_accelerations(school, name, row, code):
    pupil = school.enrol(f"broken-{name}-{code.replace('_', '-')}")
    (body,) = pieces([])
    body[name][30] = row
    send(pupil, 0, body)
    expected = ["learnt"] * ROWS
    for place in (*range(HALF), *range(30 - HALF, 31 + HALF), *range(ROWS - HALF, ROWS)):
        expected[place] = "edge"
    expected[30] = code
    assert codes(school, pupil) == expected


def test_rows_that_waited_are_checked_once_their_acceleration_is_known(school, monkeypatch):
    """A knock at the seam of two batches: its velocities are possible, its acceleration is not."""
    observed = school.service.learners._log
    monkeypatch.setattr(observed, "settings", observed.settings.model_copy(update={"max_acceleration": 100.0}))
    pupil = school.enrol("knock")
    parts = pieces([30])
    parts[1]["dq"][0] = [45.0, 0.0]
    assert "limit" not in send(pupil, 0, parts[0])["rejected"]
    said = send(pupil, 1, parts[1])
    assert said["rejected"]["limit"] > 0
    found = logged(school, pupil)[1]
    beyond = np.abs(np.nan_to_num(found.ddq)).max(axis=1) > observed.settings.max_acceleration
    assert (found.code[beyond] != 0).all()
    assert beyond[:HALF].any()


def test_a_batch_that_was_taken_out_lends_no_rows(school):
    pupil = school.enrol("taken-out")
    parts = pieces([30])
    send(pupil, 0, parts[0])
    pupil.delete("observations/arm/0")
    assert send(pupil, 1, parts[1])["derived"]["ddq"]["carried"] == 0


def test_a_stream_keeps_its_window(school):
    """The rate that is read off a batch wavers; a window that did too would learn rows twice, or not at all."""
    rows = recording(samples=3 * ROWS, rate=104.0)
    assert window(104.0) != window(116.0)
    pupil = school.enrol("wavering")
    parts = pieces([ROWS, 2 * ROWS], rows)
    for each, stretch in zip(parts, (1.0, 1.12, 1.0), strict=True):
        begin = each["t"][0]
        each["t"] = [begin + (value - begin) / stretch for value in each["t"]]
    said = [send(pupil, sequence, each) for sequence, each in enumerate(parts)]
    assert {each["derived"]["ddq"]["window"] for each in said} == {window(104.0)}


@pytest.mark.parametrize("rate", [1.0, 40.0])
def test_slow_streams_are_refused_with_the_rate_found_and_needed(school, rate):
    pupil = school.enrol(f"slow-{rate:g}")
    body = part(recording(samples=30, rate=rate), 0, 30, without=("ddq",))
    said = pupil.refused("POST", "observations", 422, "invalid_request", json=batch(0, body))
    assert said["detail"][0]["field"] == "ddq"
    assert f"{rate:g} rows a second" in said["detail"][0]["value"]
    assert "at least 50 rows a second" in said["detail"][0]["expected"]
    assert logged(school, pupil) == []
    assert send(pupil, 0, part(recording(samples=30, rate=rate), 0, 30))["accepted"] == 30


@pytest.mark.parametrize(
    "times",
    [
        pytest.param([None, None, 0.3], id="one time"),
        pytest.param([0.0, 0.0, 0.0], id="standing still"),
        pytest.param([0.0, None, 0.01, None, 0.02], id="every other"),
        pytest.param([0.0, 0.01, 0.023, 0.04, 0.063, 0.093, 0.133], id="uneven"),
    ],
)
def test_times_that_tell_no_rate_are_refused(school, request, times):
    pupil = school.enrol(f"no-rate-{request.node.callspec.id.replace(' ', '-')}")
    body = part(recording(), 0, len(times), without=("ddq",)) | {"t": times}
    said = pupil.refused("POST", "observations", 422, "invalid_request", json=batch(0, body))
    assert said["detail"][0]["field"] == "t"
    assert logged(school, pupil) == []
