"""Contiguous parts, thinned rows, and the noise of a column: against what slices and `noise_level` say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.data.signals import noise_level
from service.datasets.report.signals import bounds, noise_or_share, number_parts, thin, white_noise
from service.datasets.store import extremes, make_preview

LENGTHS = st.lists(st.integers(1, 40), min_size=1, max_size=12)


def parts_of(lengths: list[int]) -> np.ndarray:
    return np.repeat(np.arange(len(lengths)), lengths)


@given(LENGTHS)
def test_parts_are_numbered_by_their_breaks(lengths: list[int]) -> None:
    part = parts_of(lengths)
    assert (number_parts(len(part), [np.diff(part) != 0]) == part).all()
    starts, ends = bounds(part)
    assert (ends - starts).tolist() == lengths


@given(LENGTHS, st.integers(1, 60), st.integers(0, 6))
def test_thinned_rows_keep_their_distance_from_the_ends(lengths: list[int], most: int, margin: int) -> None:
    part = parts_of(lengths)
    rows = thin(part, most, margin)
    allowed = [
        row for row in range(len(part)) if margin <= row - (part < part[row]).sum() < lengths[part[row]] - margin
    ]
    assert len(rows) == min(most, len(allowed))
    assert (np.diff(rows) > 0).all()
    assert set(rows.tolist()) <= set(allowed)


def test_noise_is_that_of_noise_level() -> None:
    rng = np.random.default_rng(1)
    part = parts_of([200, 5, 90, 1, 300])
    values = np.sin(np.arange(len(part)) / 50) + 0.02 * rng.standard_normal(len(part))
    episodes = [values[part == k][:, None] for k in range(5)]
    assert white_noise(values, part) == pytest.approx(noise_level(episodes)[0], rel=1e-12)
    short = parts_of([2, 2, 2])
    episodes = [values[:6][short == k][:, None] for k in range(3)]
    assert white_noise(values[:6], short) is None
    assert noise_or_share(values[:6], short) == pytest.approx(noise_level(episodes)[0], rel=1e-12)


def test_jumps_are_no_noise() -> None:
    rng = np.random.default_rng(3)
    values = np.sign(np.sin(np.arange(4000) / 30)) + 0.01 * rng.standard_normal(4000)
    part = np.zeros(4000, int)
    assert white_noise(values, part, robust=True) == pytest.approx(0.01, rel=0.25)
    assert (white_noise(values, part) or 0) > 0.05
    coarse = np.round(values, 1)
    assert white_noise(coarse, part, robust=True) == white_noise(coarse, part)


def test_noise_passes_over_missing_values() -> None:
    rng = np.random.default_rng(2)
    values = 0.1 * rng.standard_normal(5000)
    gone = np.zeros(5000, bool)
    gone[[100, 101, 2500]] = True
    values[gone] = np.nan
    part = number_parts(5000, [gone[1:] | gone[:-1]])
    assert white_noise(values, part) == pytest.approx(0.1, rel=0.1)


@given(st.integers(1, 300), st.integers(2, 80), st.integers(0, 5))
def test_a_preview_keeps_the_extremes(count: int, points: int, seed: int) -> None:
    table = np.random.default_rng(seed).integers(0, 20, (count, 2)).astype(float)
    for joint, (rows, values) in enumerate(extremes(count, "q", lambda _, first, last: table[first:last], points)):
        assert len(rows) <= points
        assert (np.diff(rows) > 0).all()
        assert (table[rows, joint] == values).all()
        assert values.max() == table[:, joint].max()
        assert values.min() == table[:, joint].min()


def test_a_preview_names_its_columns() -> None:
    t = np.arange(100) / 10
    table = np.column_stack([t, -t])
    shown = make_preview(t, np.repeat([3, 4], 50), ("a", "b"), ("q", "tau"), lambda _, i, k: table[i:k], 10)
    assert (shown.samples, shown.starts) == (100, [0, 50])
    assert [(each.quantity, each.joint) for each in shown.columns] == [
        ("q", "a"), ("q", "b"), ("tau", "a"), ("tau", "b"),
    ]  # fmt: skip
    assert shown.columns[1].values == [-each for each in shown.columns[1].t]
    with pytest.raises(ValueError, match="points is 1, expected at least 2"):
        extremes(3, "q", lambda _, first, last: table[first:last], 1)
