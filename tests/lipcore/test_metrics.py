"""Metrics against values worked out by hand, and paired differences with errors true for correlated samples."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from lipcore.data.metrics import LEVELS, RELIABILITY_LEVELS, evaluate
from lipcore.data.paired import MIN_BLOCKS, Answer, blocks, compare, difference
from lipcore.data.samples import Samples

Z95 = 1.959963984540054


def test_all_figures_equal_hand_computed_values() -> None:
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
    """Torques, means, and stds that are too small by the factor `confidence`."""
    rng = np.random.default_rng(1)
    std, noise = rng.uniform(0.1, 2.0, (20_000, 2)), np.array([0.5, 1.5])
    mean = rng.normal(size=std.shape)
    tau = mean + np.sqrt(std**2 + noise**2) * rng.standard_normal(std.shape)
    return tau, mean, std / confidence, noise / confidence


def test_calibrated_intervals_cover_what_they_promise_at_every_level() -> None:
    answer = evaluate(*gaussian())
    atol = 4 * math.sqrt(0.25 / 20_000)
    assert np.allclose(answer.coverages, np.array(LEVELS)[:, None], atol=atol)
    assert np.allclose(answer.reliability, np.array(RELIABILITY_LEVELS)[:, None], atol=atol)
    assert answer.coverages[LEVELS.index(0.95)].tolist() == answer.coverage.tolist()
    assert answer.widths[LEVELS.index(0.95)].tolist() == answer.width.tolist()


def test_overconfident_intervals_cover_less_at_every_level_and_timid_ones_more() -> None:
    true, proud, timid = evaluate(*gaussian()), evaluate(*gaussian(2.0)), evaluate(*gaussian(0.5))
    for name in ("coverages", "reliability"):
        assert (getattr(proud, name) < getattr(true, name)).all()
        assert (getattr(timid, name) > getattr(true, name)).all()
    assert np.allclose(proud.widths * 2, true.widths)


# the mean of seven times 0.1 is not 0.1: a variance by formula is not exactly zero
@pytest.mark.parametrize("constant", [0.0, 2.0, 0.1, 1.7])
def test_nmse_of_a_torque_that_does_not_vary_is_nan(constant: float) -> None:
    tau = np.full((7, 1), constant)
    answer = evaluate(tau, tau + 0.1, np.ones((7, 1)), np.ones(1))
    assert np.isnan(answer.nmse[0])
    assert answer.rmse[0] == pytest.approx(0.1)


@pytest.mark.parametrize(("mean", "std"), [((3, 2), (4, 2)), ((4, 2), (4, 1)), ((4,), (4, 2))])
def test_differing_shapes_are_named(mean: tuple[int, ...], std: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(4, 2\) as tau has"):
        evaluate(np.zeros((4, 2)), np.zeros(mean), np.zeros(std), np.ones(2))


def recording(t, tau, episode=None):
    """Samples (N, n) whose motion does not matter."""
    none = np.zeros_like(tau)
    episode = np.zeros(len(t), np.int64) if episode is None else np.asarray(episode, np.int64)
    names = tuple(f"joint{index}" for index in range(tau.shape[1]))
    return Samples(joint_names=names, t=np.asarray(t, float), episode=episode, q=none, dq=none, ddq=none, tau=tau)


def answers(rng, shape):
    return [Answer(rng.normal(size=shape), rng.uniform(0.1, 0.5, shape), rng.uniform(0.1, 0.5, 2)) for _ in range(2)]


def correlated(rng, seconds, step, memory, count):
    """Recordings (N, count) that stay alike for `memory` seconds, of mean 0 and deviation 1."""
    decay = np.exp(-step / memory)
    noise = rng.normal(size=(round(seconds / step), count)) * np.sqrt(1 - decay**2)
    noise[0] /= np.sqrt(1 - decay**2)
    return lfilter([1.0], [1.0, -decay], noise, axis=0)


def test_differences_are_those_of_the_metrics():
    rng = np.random.default_rng(1)
    tau = rng.normal(size=(400, 2)) * [1.0, 5.0]
    first, second = answers(rng, tau.shape)
    found = compare(recording(np.arange(400) / 10, tau), first, second)
    one, other = evaluate(tau, *first), evaluate(tau, *second)
    for name in ("nmse", "rmse", "coverage", "nlpd"):
        np.testing.assert_allclose(getattr(found, name).mean, getattr(other, name) - getattr(one, name), atol=1e-12)
    total = [np.sum(other.nlpd - one.nlpd), np.mean(other.nmse - one.nmse)]
    np.testing.assert_allclose(found.total.mean, total, atol=1e-12)
    turned = compare(recording(np.arange(400) / 10, tau), second, first)
    np.testing.assert_allclose(turned.total.mean, -found.total.mean)
    np.testing.assert_allclose(turned.total.half_width, found.total.half_width)


def test_a_joint_whose_torque_does_not_vary_has_no_nmse():
    rng = np.random.default_rng(3)
    tau = rng.normal(size=(400, 2)) * [1.0, 0.0] + [0.0, 0.1]
    found = compare(recording(np.arange(400) / 10, tau), *answers(rng, tau.shape))
    assert np.isfinite(found.nmse.mean).tolist() == [True, False]
    assert found.total.mean[1] == pytest.approx(found.nmse.mean[0])
    still = np.full_like(tau, 0.1)
    assert np.isnan(compare(recording(np.arange(400) / 10, still), *answers(rng, tau.shape)).total.mean[1])


@pytest.mark.parametrize(("seconds", "memory"), [(20, 0.02), (20, 1.0), (20, 3.0), (60, 3.0), (600, 0.3), (600, 3.0)])
def test_the_interval_misses_zero_as_rarely_as_it_says(seconds, memory):
    """Where there is no difference, chance alone makes one in 5 % of recordings; a naive error in far more."""
    step = max(0.02, seconds / 5000)
    values = correlated(np.random.default_rng(5), seconds, step, memory, 600)
    starts = blocks(recording(np.arange(len(values)) * step, np.zeros((len(values), 1))))
    wrong = difference(values, starts).significant.mean()
    assert wrong < 0.085, wrong
    naive = np.abs(values.mean(axis=0)) > 1.96 * values.std(axis=0) / np.sqrt(len(values))
    assert naive.mean() > (0.1 if memory < 0.1 else 0.3)


def test_a_difference_that_is_there_is_found():
    values = correlated(np.random.default_rng(6), 60, 0.02, 0.3, 300) + 0.5
    starts = blocks(recording(np.arange(3000) / 50, np.zeros((3000, 1))))
    assert difference(values, starts).significant.mean() > 0.9


def test_a_single_block_tells_nothing():
    found = difference(np.array([[1.0], [2.0]]), np.array([0]))
    assert (found.mean.tolist(), found.standard_error.tolist()) == ([1.5], [np.inf])
    assert not found.significant.any()


def test_blocks_are_seconds_that_end_with_their_episode():
    t = np.arange(60) / 20
    episode = np.repeat([0, 1], [25, 35])
    assert blocks(recording(t, np.zeros((60, 1)), episode)).tolist() == [0, 20, 25, 45]


def test_many_episodes_are_blocks_of_their_own():
    t, episode = np.arange(400) / 4, np.repeat(np.arange(MIN_BLOCKS), 400 // MIN_BLOCKS)
    assert blocks(recording(t, np.zeros((400, 1)), episode)).tolist() == list(range(0, 400, 400 // MIN_BLOCKS))
