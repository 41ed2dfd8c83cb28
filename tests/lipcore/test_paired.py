"""Paired differences: figures are those of the metrics, and the standard error is true for correlated samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from lipcore.data.metrics import evaluate
from lipcore.data.paired import MAX_BLOCKS, MIN_BLOCKS, Answer, blocks, compare, difference
from lipcore.data.samples import Samples


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


def test_equal_answers_do_not_differ():
    rng = np.random.default_rng(2)
    tau = rng.normal(size=(400, 2))
    answer = answers(rng, tau.shape)[0]
    found = compare(recording(np.arange(400) / 10, tau), answer, answer)
    assert not found.total.mean.any()
    assert not found.total.standard_error.any()
    assert not found.total.significant.any()


def test_a_joint_whose_torque_does_not_vary_has_no_nmse():
    rng = np.random.default_rng(3)
    tau = rng.normal(size=(400, 2)) * [1.0, 0.0] + [0.0, 0.1]
    found = compare(recording(np.arange(400) / 10, tau), *answers(rng, tau.shape))
    assert np.isfinite(found.nmse.mean).tolist() == [True, False]
    assert found.total.mean[1] == pytest.approx(found.nmse.mean[0])
    still = np.full_like(tau, 0.1)
    assert np.isnan(compare(recording(np.arange(400) / 10, still), *answers(rng, tau.shape)).total.mean[1])


def test_uncorrelated_blocks_have_the_textbook_error_widened_a_little():
    rng = np.random.default_rng(4)
    values = rng.normal(size=(640, 200))
    found = difference(values, np.arange(0, 640, 10))
    textbook = values.std(axis=0, ddof=1) / np.sqrt(640)
    assert 1.0 < np.median(found.standard_error / textbook) < 1.15


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


def test_blocks_grow_with_the_recording():
    starts = blocks(recording(np.arange(5000) / 10, np.zeros((5000, 1))))
    assert MAX_BLOCKS / 2 < len(starts) <= MAX_BLOCKS
    assert set(np.diff(starts).tolist()) == {80}
    assert starts[0] == 0
