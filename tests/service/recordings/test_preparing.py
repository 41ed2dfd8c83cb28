"""Staged columns to staged samples: every joint alike, every step said, nothing left of what was refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.interpolate import Akima1DInterpolator
from scipy.signal import butter, sosfiltfilt

from lipcore.preparation.recipe import Recipe
from service.datasets.staging import QUANTITIES, Staged, column, prepare
from service.foundation.errors import InvalidDataError
from service.foundation.settings import Settings
from service.storage.storage import Disk

RATE = 90.0
ROWS = 900
EVEN = np.arange(ROWS) / RATE
NAMES = ("shoulder", "elbow", "wrist")


def signals(t, joint):
    q = np.sin((1 + 0.5 * joint) * t) + 0.2 * np.cos(3.3 * t + joint)
    dq = (1 + 0.5 * joint) * np.cos((1 + 0.5 * joint) * t) - 0.66 * np.sin(3.3 * t + joint)
    ddq = -((1 + 0.5 * joint) ** 2) * np.sin((1 + 0.5 * joint) * t) - 2.178 * np.cos(3.3 * t + joint)
    return {"q": q, "dq": dq, "ddq": ddq, "tau": 2 * ddq + 9 * np.cos(q)}


@pytest.fixture
def staged(tmp_path):
    """Make staged columns of three joints."""

    def make(names=("q", "tau"), t=EVEN, **others):
        raw = Staged(tmp_path, NAMES, Disk(Settings(home=tmp_path)))
        rows = {} if t is None else {"t": t}
        clock = np.arange(ROWS) / RATE if t is None else np.where(np.isfinite(t), t, 0)
        for joint in range(3):
            rows |= {column(name, joint): signals(clock, joint)[name] for name in names}
        raw.append(rows | others)
        return raw

    return make


def test_every_joint_comes_out_with_all_quantities_beside_what_was_read(staged, tmp_path):
    raw = staged()
    prepared = prepare(raw, tmp_path, Recipe(), 30)
    made = prepared.staged
    assert made.joint_names == NAMES
    assert made.quantities == QUANTITIES
    assert made.rows == len(made.read("t")) == len(made.read("episode")) == ROWS - 46
    for joint in range(3):
        true = signals(made.read("t"), joint)
        for name in QUANTITIES:
            found = made.read(column(name, joint))
            assert np.abs(found - true[name])[46:-46].max() < 0.02 * np.ptp(true[name])
    np.testing.assert_array_equal(raw.read("q1"), signals(np.arange(ROWS) / RATE, 0)["q"])
    assert json.loads(json.dumps(prepared.steps)) == prepared.steps
    assert all(step["step"] and step["text"] for step in prepared.steps)


def test_facts(staged, tmp_path):
    t = np.arange(ROWS) / RATE
    t[400:] += 2
    t[650] = t[649]
    raw = staged(("q", "dq", "tau"), t, episode=np.repeat([3.0, 8.0], [600, 300]))
    raw_tau = raw.read("tau2")
    raw_tau[[10, 11]] = np.nan, np.inf
    raw.folder.joinpath("tau2.f64").write_bytes(raw_tau.tobytes())
    prepared = prepare(raw, tmp_path, Recipe(rate_hz=30), 30)
    assert prepared.rate_hz == pytest.approx(30, rel=1e-3)
    edges = prepared.steps[-2]["samples"]
    assert edges == pytest.approx(6 * 23, abs=6)
    assert prepared.staged.rows == pytest.approx((ROWS - edges) / 3, abs=3)
    assert (prepared.episodes, prepared.gaps, prepared.missing, prepared.repeated) == (3, 1, 2, 1)
    assert (prepared.derived, prepared.cutoff_hz) == (("ddq",), 4.0)
    assert [step["first_row"] for step in prepared.steps[:2]] == [11, 651]
    assert prepared.steps[4]["rate_hz"] == pytest.approx(90, rel=1e-3)
    assert [step["step"] for step in prepared.steps] == [
        "leave_out",
        "leave_out",
        "split",
        "split",
        "resample",
        "low_pass",
        "differentiate",
        "trim",
        "thin",
    ]


def test_the_steps_say_all_that_is_needed_to_do_it_by_hand(staged, tmp_path):
    """Uneven stamps with a gap, done anew with SciPy from the parameters of the steps alone."""
    t = np.arange(ROWS) / RATE + np.random.default_rng(0).uniform(0, 0.7, ROWS) / RATE
    t[500:] += 3
    prepared = prepare(staged(t=t), tmp_path, Recipe(cutoff_hz=5), 30)
    split, resample, low_pass, _, trim = json.loads(json.dumps(prepared.steps))
    rate, q = resample["rate_hz"], signals(t, 1)["q"]
    sections = butter(4, low_pass["cutoff_hz"], fs=rate, output="sos")
    ends = np.flatnonzero(np.diff(t) > split["longer_than_s"]) + 1
    found = []
    for part in np.split(np.arange(ROWS), ends):
        times = np.arange(t[part[0]], t[part[-1]], 1 / rate)
        even = sosfiltfilt(sections, Akima1DInterpolator(t[part], q[part])(times))
        dq = np.gradient(even, 1 / rate, edge_order=2)
        ddq = np.gradient(sosfiltfilt(sections, dq), 1 / rate, edge_order=2)
        found.append(np.stack([times, even, dq, ddq])[:, trim["first"] : len(times) - trim["last"]])
    for name, expected in zip(("t", "q2", "dq2", "ddq2"), np.hstack(found), strict=True):
        np.testing.assert_allclose(prepared.staged.read(name), expected, rtol=0, atol=1e-6)


def test_what_is_complete_passes_unchanged(staged, tmp_path):
    raw = staged(QUANTITIES, None)
    prepared = prepare(raw, tmp_path, Recipe(), 30)
    assert prepared.steps == []
    assert prepared.rate_hz is None
    np.testing.assert_array_equal(prepared.staged.read("t"), np.arange(ROWS))
    for joint in range(3):
        for name in QUANTITIES:
            np.testing.assert_array_equal(prepared.staged.read(column(name, joint)), raw.read(column(name, joint)))


def test_a_run_of_missing_values_in_one_joint_leaves_these_rows_out_of_all(staged, tmp_path):
    raw = staged(QUANTITIES)
    damaged = raw.read("ddq3")
    damaged[100:150] = np.nan
    raw.folder.joinpath("ddq3.f64").write_bytes(damaged.tobytes())
    prepared = prepare(raw, tmp_path, Recipe(), 30)
    assert (prepared.missing, prepared.gaps, prepared.staged.rows) == (50, 1, ROWS - 50)
    np.testing.assert_array_equal(prepared.staged.read("q1"), np.delete(raw.read("q1"), np.s_[100:150]))


@pytest.mark.parametrize(
    ("made", "recipe", "field", "value", "expected"),
    [
        ({"t": None}, Recipe(), "t", "missing", "times, since dq and ddq must be derived"),
        ({}, Recipe(cutoff_hz=45), "cutoff", "45 Hz", "less than half the rate of 90 Hz"),
        ({}, Recipe(trim_s=4.9), "rows", "18", "at least 30 samples after trimming the filter's edges"),
        ({"names": QUANTITIES}, Recipe(trim_s=4.9), "rows", "18", "at least 30 samples after leaving out what cannot"),
        ({}, Recipe(rate_hz=1000), "rate", "1000 Hz", "at most the recording's, 90 Hz"),
    ],
)
def test_what_is_refused_names_field_and_value(staged, tmp_path, made, recipe, field, value, expected):
    raw = staged(**made)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InvalidDataError) as caught:
        prepare(raw, tmp_path, recipe, 30)
    (said,) = caught.value.detail
    assert (said.field, said.value) == (field, value)
    assert expected in said.expected
    assert sorted(tmp_path.iterdir()) == before
