"""Tests of metrics: by hand, paired with standard errors for correlated samples, and summed over a stream."""

import json
import math
from dataclasses import fields
from functools import reduce
from itertools import pairwise
from operator import add

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from lipcore.data.metrics import (
    LEVELS,
    MIN_BLOCKS,
    RELIABILITY_LEVELS,
    TorqueDistribution,
    average_differences,
    blocks,
    compare,
    evaluate,
)
from lipcore.data.samples import Samples
from lipcore.online.record import Record, error_floor

Z95 = 1.959963984540054


def test_metrics_match_hand_computed_values() -> None:
    tau = np.array([[1.0], [3.0], [5.0], [7.0]])
    mean = tau - np.array([[0.0], [1.0], [-1.0], [2.0]])
    std, noise = np.full((4, 1), 0.3), np.array([0.4])  # total 0.5
    answer = evaluate(tau, mean, std, noise)
    assert answer.nmse[0] == pytest.approx(1.5 / 5.0)
    assert answer.rmse[0] == pytest.approx(math.sqrt(1.5))
    assert answer.coverage[0] == 0.25  # the half width is 0.98: an error of 1 is outside
    assert answer.width[0] == pytest.approx(2 * Z95 * 0.5)
    assert answer.nlpd[0] == pytest.approx(0.5 * math.log(2 * math.pi * 0.25) + 0.5 * 1.5 / 0.25)
    assert answer.level == 0.95


def gaussian(confidence: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return torques, means and standard deviations that are too small by the factor `confidence`."""
    rng = np.random.default_rng(1)
    std, noise = rng.uniform(0.1, 2.0, (20_000, 2)), np.array([0.5, 1.5])
    mean = rng.normal(size=std.shape)
    tau = mean + np.sqrt(std**2 + noise**2) * rng.standard_normal(std.shape)
    return tau, mean, std / confidence, noise / confidence


def test_calibrated_intervals_have_nominal_coverage_at_every_level() -> None:
    answer = evaluate(*gaussian())
    atol = 4 * math.sqrt(0.25 / 20_000)
    assert np.allclose(answer.coverages, np.array(LEVELS)[:, None], atol=atol)
    assert np.allclose(answer.reliability, np.array(RELIABILITY_LEVELS)[:, None], atol=atol)
    assert answer.coverages[LEVELS.index(0.95)].tolist() == answer.coverage.tolist()
    assert answer.widths[LEVELS.index(0.95)].tolist() == answer.width.tolist()


def test_coverage_reveals_overconfident_and_cautious_intervals() -> None:
    true, overconfident, cautious = evaluate(*gaussian()), evaluate(*gaussian(2.0)), evaluate(*gaussian(0.5))
    for name in ("coverages", "reliability"):
        assert (getattr(overconfident, name) < getattr(true, name)).all()
        assert (getattr(cautious, name) > getattr(true, name)).all()
    assert np.allclose(overconfident.widths * 2, true.widths)


# the mean of seven times 0.1 is not 0.1: a computed variance is not exactly zero
@pytest.mark.parametrize("constant", [0.0, 2.0, 0.1, 1.7])
def test_nmse_of_a_constant_torque_is_nan(constant: float) -> None:
    tau = np.full((7, 1), constant)
    answer = evaluate(tau, tau + 0.1, np.ones((7, 1)), np.ones(1))
    assert np.isnan(answer.nmse[0])
    assert answer.rmse[0] == pytest.approx(0.1)


@pytest.mark.parametrize(("mean", "std"), [((3, 2), (4, 2)), ((4, 2), (4, 1)), ((4,), (4, 2))])
def test_mismatched_shapes_are_named(mean: tuple[int, ...], std: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(4, 2\), the shape of tau"):
        evaluate(np.zeros((4, 2)), np.zeros(mean), np.zeros(std), np.ones(2))


def recording(t, tau, episode=None):
    """Return samples (N, n) whose motion does not matter."""
    none = np.zeros_like(tau)
    episode = np.zeros(len(t), np.int64) if episode is None else np.asarray(episode, np.int64)
    names = tuple(f"joint{index}" for index in range(tau.shape[1]))
    return Samples(joint_names=names, t=np.asarray(t, float), episode=episode, q=none, dq=none, ddq=none, tau=tau)


def random_predictions(rng, shape):
    return [
        TorqueDistribution(rng.normal(size=shape), rng.uniform(0.1, 0.5, shape), rng.uniform(0.1, 0.5, 2))
        for _ in range(2)
    ]


def autoregressive(rng, rho, rows, count):
    """Return recordings (rows, count) of mean 0 and deviation 1 with correlation `rho` between neighbours."""
    noise = rng.normal(size=(rows, count)) * np.sqrt(1 - rho**2)
    noise[0] /= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], noise, axis=0)


def test_differences_match_the_metrics():
    rng = np.random.default_rng(1)
    tau = rng.normal(size=(400, 2)) * [1.0, 5.0]
    first, second = random_predictions(rng, tau.shape)
    found = compare(recording(np.arange(400) / 10, tau), first, second)
    one, other = evaluate(tau, *first), evaluate(tau, *second)
    for name in ("nmse", "rmse", "coverage", "nlpd"):
        np.testing.assert_allclose(getattr(found, name).mean, getattr(other, name) - getattr(one, name), atol=1e-12)
    total = [np.sum(other.nlpd - one.nlpd), np.mean(other.nmse - one.nmse)]
    np.testing.assert_allclose(found.total.mean, total, atol=1e-12)
    turned = compare(recording(np.arange(400) / 10, tau), second, first)
    np.testing.assert_allclose(turned.total.mean, -found.total.mean)
    np.testing.assert_allclose(turned.total.half_width, found.total.half_width)


def test_joint_with_constant_torque_has_no_nmse():
    rng = np.random.default_rng(3)
    tau = rng.normal(size=(400, 2)) * [1.0, 0.0] + [0.0, 0.1]
    found = compare(recording(np.arange(400) / 10, tau), *random_predictions(rng, tau.shape))
    assert np.isfinite(found.nmse.mean).tolist() == [True, False]
    assert found.total.mean[1] == pytest.approx(found.nmse.mean[0])
    still = np.full_like(tau, 0.1)
    assert np.isnan(compare(recording(np.arange(400) / 10, still), *random_predictions(rng, tau.shape)).total.mean[1])


@pytest.mark.parametrize(("seconds", "memory"), [(20, 0.02), (20, 1.0), (20, 3.0), (60, 3.0), (600, 0.3), (600, 3.0)])
def test_interval_excludes_zero_as_rarely_as_stated(seconds, memory):
    """Without a difference, 5 % of the intervals exclude zero; naive intervals exclude it far more often."""
    step = max(0.02, seconds / 5000)
    values = autoregressive(np.random.default_rng(5), np.exp(-step / memory), round(seconds / step), 600)
    starts = blocks(recording(np.arange(len(values)) * step, np.zeros((len(values), 1))))
    wrong = average_differences(values, starts).significant.mean()
    assert wrong < 0.085, wrong
    naive = np.abs(values.mean(axis=0)) > 1.96 * values.std(axis=0) / np.sqrt(len(values))
    assert naive.mean() > (0.1 if memory < 0.1 else 0.3)


def test_real_difference_is_found():
    values = autoregressive(np.random.default_rng(6), np.exp(-0.02 / 0.3), 3000, 300) + 0.5
    starts = blocks(recording(np.arange(3000) / 50, np.zeros((3000, 1))))
    assert average_differences(values, starts).significant.mean() > 0.9


def test_single_block_has_infinite_standard_error():
    found = average_differences(np.array([[1.0], [2.0]]), np.array([0]))
    assert (found.mean.tolist(), found.standard_error.tolist()) == ([1.5], [np.inf])
    assert not found.significant.any()


@pytest.mark.parametrize(
    ("rate", "lengths", "starts"),
    [(20, [25, 35], [0, 20, 25, 45]), (4, [400 // MIN_BLOCKS] * MIN_BLOCKS, range(0, 400, 400 // MIN_BLOCKS))],
    ids=["seconds within an episode", "many episodes are one block each"],
)
def test_blocks_do_not_cross_episodes(rate, lengths, starts):
    rows = sum(lengths)
    given = recording(np.arange(rows) / rate, np.zeros((rows, 1)), np.repeat(np.arange(len(lengths)), lengths))
    assert blocks(given).tolist() == list(starts)


Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@st.composite
def rows(draw: st.DrawFn, max_rows: int = 30) -> Rows:
    """Draw torques far from zero with small errors, like the weight of an arm."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (draw(st.integers(1, max_rows)), 3)
    gravity, scale = draw(st.floats(-1e4, 1e4)), draw(st.floats(1e-3, 1e3))
    tau = gravity + scale * rng.standard_normal(shape)
    mean = tau + rng.uniform(0, 3, 3) * rng.standard_normal(shape)
    return tau, mean, rng.uniform(0.0, 2.0, shape), rng.uniform(0.1, 1.0, 3)


def record_parts(data: Rows, bounds: list[int]) -> list[Record]:
    tau, mean, std, noise = data
    return [Record.of(tau[a:b], mean[a:b], std[a:b], noise) for a, b in pairwise([0, *bounds, len(tau)])]


@given(data=rows(), at=st.lists(st.integers(0, 30), max_size=4))
@settings(deadline=None)
def test_summed_records_equal_one_record_of_all_rows(data: Rows, at: list[int]) -> None:
    parts, expected = record_parts(data, sorted(min(each, len(data[0])) for each in at)), Record.of(*data)
    for order in (parts, parts[::-1]):
        summed = reduce(add, order, Record.empty(3))
        back = Record.from_json(json.loads(json.dumps(summed.to_json(), allow_nan=False)))
        assert back.rows == summed.rows == expected.rows
        for field in fields(Record):
            one, other, stored = (getattr(each, field.name) for each in (summed, expected, back))
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13 * (1 + np.abs(data[0]).max()))
            assert np.array_equal(stored, one)


@given(data=rows(max_rows=60), at=st.integers(0, 60))
@settings(deadline=None)
def test_record_metrics_match_the_metrics_of_its_rows(data: Rows, at: int) -> None:
    record, expected = reduce(add, record_parts(data, [min(at, len(data[0]))])), evaluate(*data)
    assert np.allclose(record.rmse, expected.rmse, rtol=1e-12, atol=0)
    assert np.allclose(record.coverage, expected.coverage, rtol=1e-12, atol=0)
    assert np.allclose(record.nlpd, expected.nlpd, rtol=1e-12, atol=1e-12)
    # means near 1e4 that differ by 1e-3 have only so many digits
    digits = 1e-12 + 1e-14 * np.abs(data[0]).max() / np.maximum(data[0].std(axis=0), 1e-300)
    known = ~np.isnan(expected.nmse)
    assert (np.abs(record.nmse[known] / expected.nmse[known] - 1) <= digits[known]).all()
    assert (np.isnan(record.nmse) == np.isnan(expected.nmse)).all()


def test_record_means_match_hand_computed_values() -> None:
    tau, mean = np.array([[1.0], [3.0]]), np.array([[1.5], [1.0]])
    record = Record.of(tau, mean, np.array([[0.3], [0.0]]), np.array([0.4]))
    assert record.error.tolist() == [0.75]
    assert record.squared.tolist() == [2.125]
    assert (record.mean.tolist(), record.spread.tolist()) == ([2.0], [1.0])
    # ±1.96 · 0.5 contains −0.5; ±1.96 · 0.4 does not contain 2
    assert record.inside.tolist() == [0.5]
    assert record.standardised[0] == pytest.approx((0.25 / 0.25 + 4.0 / 0.16) / 2)
    assert record.variance[0] == pytest.approx(0.045)
    assert record.noise[0] == pytest.approx(0.16)


# the mean of seven times 0.1 is not 0.1
def test_summed_records_of_constant_torque_have_no_nmse() -> None:
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
def test_damaged_json_is_rejected_by_name(change: dict, message: str) -> None:
    values = {name: value for name, value in (Record.empty(2).to_json() | change).items() if value is not ...}
    with pytest.raises(ValueError, match=message):
        Record.from_json(values)


def test_no_rows_make_the_empty_record() -> None:
    nothing = np.zeros((0, 2))
    record = Record.of(nothing, nothing, nothing, np.ones(2))
    assert (record.rows, record.n_joints) == (0, 2)
    assert all(values == [None, None] for values in record.metrics().values())


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, np.zeros(2), r"tau has shape \(2,\), expected \(N, n\)"),
        (1, np.zeros((3, 1)), r"mean has shape \(3, 1\), expected \(3, 2\), the shape of tau"),
        (2, np.full((3, 2), np.nan), "std has values that are not finite"),
        (3, np.ones(3), r"noise_std has shape \(3,\), expected \(2,\)"),
        (3, np.zeros(2), "std and noise_std are both 0"),
    ],
    ids=str,
)
def test_rows_that_spoil_a_sum_are_rejected(place: int, value: np.ndarray, message: str) -> None:
    data = [np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2)), np.ones(2)]
    data[place] = value
    with pytest.raises(ValueError, match=message):
        Record.of(*data)


def test_records_of_different_joints_cannot_be_added() -> None:
    with pytest.raises(ValueError, match="records of 2 and 3 joints do not add"):
        _ = Record.empty(2) + Record.empty(3)


NOISE = np.array([0.05, 2.0])


def noisy_record(error: np.ndarray, noise_std: np.ndarray = NOISE) -> Record:
    return Record.of(error, np.zeros_like(error), np.zeros_like(error), noise_std)


@pytest.mark.parametrize("rows", [50, 200, 2000])
def test_noise_alone_rarely_raises_the_error_floor(rows: int) -> None:
    rng = np.random.default_rng(rows)
    floors = np.array([error_floor(noisy_record(NOISE * rng.standard_normal((rows, 2)))) for _ in range(1500)])
    assert 0 < (floors > 0).mean() < 0.008
    assert (floors <= 6 * np.sqrt(2 / rows) * NOISE**2).all()


def test_few_rows_have_no_error_floor() -> None:
    assert error_floor(noisy_record(np.full((49, 2), 100.0))).tolist() == [0.0, 0.0]
    assert (error_floor(noisy_record(np.full((50, 2), 100.0))) > 9000).all()
    assert error_floor(Record.empty(2)).tolist() == [0.0, 0.0]
