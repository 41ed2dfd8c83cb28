"""How much the rows of a fast stream count for, and those whose errors last."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.data.independence import (
    INDEPENDENT_HZ,
    even_weights,
    recording_weights,
    residual_correlation,
    stream_weights,
)
from lipcore.data.samples import Samples


@pytest.mark.parametrize("rate", [100.0, 250.0, 1000.0])
def test_a_second_of_a_fast_stream_counts_the_same_at_every_rate(rate: float) -> None:
    time = 1e9 + np.arange(int(4 * rate)) / rate
    assert stream_weights(time).sum() == pytest.approx(4 * INDEPENDENT_HZ, rel=1e-3)
    assert stream_weights(time[1:], time[0]).sum() == pytest.approx((4 - 1 / rate) * INDEPENDENT_HZ, rel=1e-3)


def test_rows_of_a_slow_stream_count_in_full() -> None:
    assert (stream_weights(np.arange(5) / INDEPENDENT_HZ) > 1 - 1e-12).all()
    assert (stream_weights(np.arange(5) / 2.0) == 1).all()
    assert (stream_weights(np.array([3.0])) == 1).all()
    assert (stream_weights(np.array([3.0]), 2.0) == 1).all()


def test_a_wrong_time_does_not_change_what_evenly_spaced_rows_count_for() -> None:
    time = 5.0 + np.arange(20) / 500
    expected = np.full(20, INDEPENDENT_HZ / 500)
    np.testing.assert_allclose(even_weights(time), expected)
    for wrong in (np.nan, 4.0, 1e9, time[6]):
        np.testing.assert_allclose(even_weights(np.where(np.arange(20) == 7, wrong, time)), expected, rtol=1e-9)
    assert (even_weights(np.array([3.0])) == 1).all()
    assert (even_weights(np.arange(5.0)) == 1).all()


def test_rows_that_were_bunched_count_for_the_time_they_took() -> None:
    """Ten frames that wait for each other and arrive together stand for the ten milliseconds since the last ones."""
    even = np.arange(1, 201) / 1000
    bunched = np.repeat(even[9::10], 10) + np.tile(np.arange(10), 20) * 1e-6
    assert stream_weights(bunched, 0.0).sum() == pytest.approx(stream_weights(even, 0.0).sum(), rel=1e-2)


def test_rows_without_times_share_those_since_the_batch_before() -> None:
    together = stream_weights(np.full(100, 7.0), 6.9)
    assert (together == together[0]).all()
    assert together.sum() == pytest.approx(0.1 * INDEPENDENT_HZ)
    assert (stream_weights(np.full(100, 7.0)) == 1).all()


def test_time_that_goes_backwards_counts_nothing() -> None:
    assert stream_weights(np.array([3.0]), 4.0)[0] == 0
    assert len(stream_weights(np.empty(0))) == 0


@given(st.permutations(range(8)))
def test_weights_belong_to_rows_and_not_to_places(order: list[int]) -> None:
    time = np.cumsum([0.001, 0.002, 0.001, 0.05, 0.003, 0.001, 0.001, 0.01])
    np.testing.assert_allclose(stream_weights(time[order], 0.0), stream_weights(time, 0.0)[order])


@pytest.mark.parametrize("rate", [1000.0, 100.0, 8.0])
def test_rows_of_a_recording_count_for_their_time(rate: float) -> None:
    time = np.r_[np.arange(50) / rate, 5 + np.arange(50) / rate, 9.0]
    episode = np.r_[np.zeros(50), np.ones(50), 2].astype(np.int64)
    found = recording_weights(time, episode)
    np.testing.assert_allclose(found, np.r_[np.full(100, min(1.0, 10 / rate)), 1.0], rtol=1e-9)
    # a piece with one more row at both ends knows what the whole knows
    np.testing.assert_array_equal(recording_weights(time[29:72], episode[29:72])[1:-1], found[30:71])
    assert len(recording_weights(np.empty(0), np.empty(0, np.int64))) == 0


def noisy(size: int, memory: float, seed: int, episodes: int = 1) -> tuple[np.ndarray, Samples]:
    """An autoregression e_k = φ e_{k−1} + white, in each of several recordings."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((size, 2))
    episode = np.arange(size) * episodes // size
    for k in range(1, size):
        if episode[k] == episode[k - 1]:
            white[k] += memory * white[k - 1]
    nothing = np.zeros((size, 2))
    return white, Samples(("a", "b"), np.arange(size) * 0.01, episode, nothing, nothing, nothing, white)


@pytest.mark.parametrize("episodes", [1, 5])
def test_rows_that_an_independent_one_stands_for(episodes: int) -> None:
    assert residual_correlation(*noisy(5000, 0.0, 1, episodes)) == pytest.approx(1.0, abs=0.1)
    for memory in (0.5, 0.8):  # 1 + 2 Σ φ^k
        expected = (1 + memory) / (1 - memory)
        assert residual_correlation(*noisy(20_000, memory, 2, episodes)) == pytest.approx(expected, rel=0.2)
    assert residual_correlation(np.zeros((3, 2)), noisy(3, 0.0, 3)[1]) == 1.0
