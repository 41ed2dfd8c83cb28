"""Prequential records: figures of all rows however they were cut up, and the floor of uncertainty that they prove."""

import json
from dataclasses import fields
from functools import reduce
from itertools import pairwise
from operator import add

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lipcore.data.metrics import evaluate
from lipcore.online.record import Record, error_floor

Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@st.composite
def rows(draw: st.DrawFn, most: int = 30) -> Rows:
    """Torques far from zero beside small errors, as the weight of an arm has them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (draw(st.integers(1, most)), 3)
    gravity, scale = draw(st.floats(-1e4, 1e4)), draw(st.floats(1e-3, 1e3))
    tau = gravity + scale * rng.standard_normal(shape)
    mean = tau + rng.uniform(0, 3, 3) * rng.standard_normal(shape)
    return tau, mean, rng.uniform(0.0, 2.0, shape), rng.uniform(0.1, 1.0, 3)


def cut(data: Rows, bounds: list[int]) -> list[Record]:
    tau, mean, std, noise = data
    return [Record.of(tau[a:b], mean[a:b], std[a:b], noise) for a, b in pairwise([0, *bounds, len(tau)])]


@given(data=rows(), at=st.lists(st.integers(0, 30), max_size=4))
@settings(deadline=None)
def test_sum_of_parts_in_any_order_is_the_record_of_all_rows_at_once(data: Rows, at: list[int]) -> None:
    parts, expected = cut(data, sorted(min(each, len(data[0])) for each in at)), Record.of(*data)
    for order in (parts, parts[::-1]):
        summed = reduce(add, order, Record.empty(3))
        back = Record.from_json(json.loads(json.dumps(summed.to_json(), allow_nan=False)))
        assert back.rows == summed.rows == expected.rows
        for field in fields(Record):
            one, other, stored = (getattr(each, field.name) for each in (summed, expected, back))
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13 * (1 + np.abs(data[0]).max()))
            assert np.array_equal(stored, one)


@given(data=rows(most=60), at=st.integers(0, 60))
@settings(deadline=None)
def test_figures_are_those_of_the_metrics_of_the_same_rows(data: Rows, at: int) -> None:
    record, expected = reduce(add, cut(data, [min(at, len(data[0]))])), evaluate(*data)
    assert np.allclose(record.rmse, expected.rmse, rtol=1e-12, atol=0)
    assert np.allclose(record.coverage, expected.coverage, rtol=1e-12, atol=0)
    assert np.allclose(record.nlpd, expected.nlpd, rtol=1e-12, atol=1e-12)
    # means of torques of 1e4 that differ by 1e-3 have themselves only so many digits
    digits = 1e-12 + 1e-14 * np.abs(data[0]).max() / np.maximum(data[0].std(axis=0), 1e-300)
    known = ~np.isnan(expected.nmse)
    assert (np.abs(record.nmse[known] / expected.nmse[known] - 1) <= digits[known]).all()
    assert (np.isnan(record.nmse) == np.isnan(expected.nmse)).all()


def test_means_equal_hand_computed_values() -> None:
    tau, mean = np.array([[1.0], [3.0]]), np.array([[1.5], [1.0]])
    record = Record.of(tau, mean, np.array([[0.3], [0.0]]), np.array([0.4]))
    assert record.error.tolist() == [0.75]
    assert record.squared.tolist() == [2.125]
    assert (record.mean.tolist(), record.spread.tolist()) == ([2.0], [1.0])
    # ±1.96 · 0.5 holds −0.5; ±1.96 · 0.4 does not hold 2
    assert record.inside.tolist() == [0.5]
    assert record.standardised[0] == pytest.approx((0.25 / 0.25 + 4.0 / 0.16) / 2)
    assert record.variance[0] == pytest.approx(0.045)
    assert record.noise[0] == pytest.approx(0.16)


# the mean of seven times 0.1 is not 0.1
def test_torque_that_does_not_vary_has_no_nmse_in_parts_either() -> None:
    tau = np.full((12, 1), 0.1)
    parts = [Record.of(tau[a:b], tau[a:b] + 1, 0 * tau[a:b], np.ones(1)) for a, b in ((0, 7), (7, 12))]
    assert np.isnan((parts[0] + parts[1]).nmse[0])
    assert (parts[0] + parts[1]).metrics()["nmse"] == [None]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nlpd": [1.0]}, r"record has nlpd \[1.0\], expected one finite number a joint"),
        ({"noise": [1.0, float("nan")]}, "record has noise"),
        ({"rows": 1.5}, "record has rows 1.5, expected an integer of at least 0"),
        ({"spread": ...}, "record lacks spread"),
    ],
    ids=str,
)
def test_damaged_json_is_refused_by_name(change: dict, message: str) -> None:
    values = {name: value for name, value in (Record.empty(2).to_json() | change).items() if value is not ...}
    with pytest.raises(ValueError, match=message):
        Record.from_json(values)


def test_no_rows_make_the_empty_record_of_which_nothing_is_known() -> None:
    nothing = np.zeros((0, 2))
    record = Record.of(nothing, nothing, nothing, np.ones(2))
    assert (record.rows, record.n_joints) == (0, 2)
    assert all(values == [None, None] for values in record.metrics().values())


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, np.zeros(2), r"tau has shape \(2,\), expected \(N, n\)"),
        (1, np.zeros((3, 1)), r"mean has shape \(3, 1\), expected \(3, 2\) as tau has"),
        (2, np.full((3, 2), np.nan), "std has values that are not finite"),
        (3, np.ones(3), r"noise_std has shape \(3,\), expected \(2,\)"),
        (3, np.zeros(2), "std and noise_std are both 0"),
    ],
    ids=str,
)
def test_rows_that_would_spoil_every_sum_are_refused(place: int, value: np.ndarray, message: str) -> None:
    data = [np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2)), np.ones(2)]
    data[place] = value
    with pytest.raises(ValueError, match=message):
        Record.of(*data)


def test_records_of_other_joints_do_not_add() -> None:
    with pytest.raises(ValueError, match="records of 2 and 3 joints do not add"):
        _ = Record.empty(2) + Record.empty(3)


NOISE = np.array([0.05, 2.0])


def noisy_record(error: np.ndarray, noise_std: np.ndarray = NOISE) -> Record:
    return Record.of(error, np.zeros_like(error), np.zeros_like(error), noise_std)


@pytest.mark.parametrize("rows", [50, 200, 2000])
def test_noise_alone_raises_it_for_less_than_one_record_in_a_hundred(rows: int) -> None:
    rng = np.random.default_rng(rows)
    floors = np.array([error_floor(noisy_record(NOISE * rng.standard_normal((rows, 2)))) for _ in range(1500)])
    assert 0 < (floors > 0).mean() < 0.008
    assert (floors <= 6 * np.sqrt(2 / rows) * NOISE**2).all()


def test_few_rows_prove_nothing() -> None:
    assert error_floor(noisy_record(np.full((49, 2), 100.0))).tolist() == [0.0, 0.0]
    assert (error_floor(noisy_record(np.full((50, 2), 100.0))) > 9000).all()
    assert error_floor(Record.empty(2)).tolist() == [0.0, 0.0]
