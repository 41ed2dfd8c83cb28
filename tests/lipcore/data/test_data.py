"""Tests of samples, motion and signals, and of the weights of rows of a fast stream."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lipcore.data.independence import (
    INDEPENDENT_HZ,
    even_weights,
    recording_weights,
    stream_weights,
)
from lipcore.data.motion import Motion, check_joint_types
from lipcore.data.samples import Samples
from lipcore.data.signals import differentiate, low_pass, noise_level

RATE = 100.0
SECONDS = 20
INTERIOR = slice(300, -300)
"""Samples away from the ends, over whole periods of every frequency used here."""


def phasor(signal: np.ndarray, frequency: float) -> complex:
    """Return gain and phase against sin(2π f t), from whole periods."""
    t = np.arange(len(signal)) / RATE
    return complex(2 * np.mean(signal[INTERIOR] * np.exp(-2j * np.pi * frequency * t[INTERIOR])) * 1j)


def sinusoid(frequency: float) -> np.ndarray:
    return np.sin(2 * np.pi * frequency * np.arange(int(SECONDS * RATE)) / RATE)[:, None]


def table(rows: int = 6, episode: tuple[int, ...] | None = None, names: tuple[str, ...] = ("a", "b")) -> Samples:
    values = np.arange(4.0 * rows * len(names)).reshape(4, rows, len(names))
    numbers = np.array(episode if episode is not None else [0] * rows, dtype=np.int64)
    return Samples(names, np.arange(rows) / 10, numbers, *values)


@pytest.mark.parametrize("name", ["q", "dq", "ddq", "tau"])
def test_wrong_array_shape_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} has shape \(6, 3\), expected \(6, 2\)"):
        replace(table(), **{name: np.zeros((6, 3))})


def test_episodes_are_contiguous_runs() -> None:
    assert table(6, (4, 4, 1, 1, 1, 4)).episodes() == [slice(0, 2), slice(2, 5), slice(5, 6)]
    assert table(0).episodes() == []


def test_concatenation_keeps_row_order_and_separates_episodes() -> None:
    joined = Samples.concatenate([table(3, (7, 7, 9)), table(2, (7, 7)), table(1, (0,))])
    assert joined.episode.tolist() == [0, 0, 1, 2, 2, 3]
    assert np.array_equal(joined.q, np.concatenate([table(3).q, table(2).q, table(1).q]))
    assert len(joined.episodes()) == 4


def with_elements(samples: Samples, seed: int = 0) -> Samples:
    """Return samples with random deflections of two elements."""
    return replace(samples, deflections=np.random.default_rng(seed).uniform(-1, 1, (len(samples), 4, samples.n_joints)))


@pytest.mark.parametrize("index", [slice(1, 4), np.array([4, 0]), np.arange(6) > 3], ids=["slice", "indices", "mask"])
def test_chosen_rows_keep_their_deflections(index: slice | np.ndarray) -> None:
    samples = with_elements(table())
    assert samples.deflections is not None
    for found in (samples.rows(index).deflections, samples.motion()[index].deflections):
        assert np.array_equal(found, samples.deflections[index])
    assert table().rows(index).deflections is None


def test_concatenation_keeps_deflections() -> None:
    parts = [with_elements(table(3), 1), with_elements(table(2), 2)]
    joined = Samples.concatenate(parts).deflections
    assert np.array_equal(joined, np.concatenate([part.deflections for part in parts]))
    mixed = Samples.concatenate([parts[0], table(2)]).deflections
    assert mixed is not None
    assert np.array_equal(mixed[:3], parts[0].deflections)
    assert (mixed[3:] == np.array([0, 0, 1, 1])[:, None]).all()  # unknown
    assert Samples.concatenate([table(3), table(2)]).deflections is None


@pytest.mark.parametrize("known", [False, True])
def test_motion_is_read_back_from_its_array(known: bool) -> None:
    motion = (with_elements(table()) if known else table()).motion()
    arrays = motion.arrays()
    assert arrays.shape == (6, 7 if known else 3, 2)
    assert arrays.flags.c_contiguous
    again = Motion.of(arrays)
    for name in ("q", "dq", "ddq", "deflections"):
        assert np.array_equal(getattr(again, name), getattr(motion, name))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(table(), episode=np.zeros(5, dtype=np.int64)), r"episode has shape \(5,\), expected \(6,\)"),
        (lambda: Samples.concatenate([table(), table(names=("a", "c"))]), r"joint names differ: \['a', 'c'\]"),
        (lambda: Samples.concatenate([]), "no samples"),
        (lambda: Motion.from_arrays(*np.zeros((3, 4, 2, 2))), "q has shape"),
        (lambda: check_joint_types([]), "joint_types is empty"),
        (lambda: low_pass(np.zeros((15, 2)), RATE), "signal has 15 samples, expected at least 16"),
        (lambda: differentiate(np.zeros((2, 1)), RATE), "signal has 2 samples, expected at least 3"),
    ],
)
def test_invalid_arrays_are_rejected(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", ["q", "dq", "ddq"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_value_is_located(name: str, value: float) -> None:
    arrays = {key: np.zeros((3, 2)) for key in ("q", "dq", "ddq")}
    arrays[name][2, 1] = value
    with pytest.raises(ValueError, match=rf"^{name}\[2, 1\] is {value}, expected a finite number"):
        Motion.from_arrays(**arrays)
    with pytest.raises(ValueError, match=rf"has shape .*{'' if name == 'q' else '3, 1'}"):
        Motion.from_arrays(**(arrays | {name: np.zeros((3, 1))}))


def test_low_pass_keeps_slow_and_removes_fast_signals() -> None:
    gain = {f: phasor(low_pass(sinusoid(f), RATE, cutoff=4.0)[:, 0], f) for f in (1.0, 4.0, 8.0, 16.0)}
    assert max(map(abs, np.angle([gain[1.0], gain[4.0]]))) < 1e-3  # without delay
    gain = {f: abs(value) for f, value in gain.items()}
    assert gain[1.0] == pytest.approx(1.0, abs=1e-3)
    # each of the two passes leaves 1/√2 at the cut-off
    assert gain[4.0] == pytest.approx(0.5, abs=1e-3)
    assert gain[8.0] < 0.01
    assert gain[16.0] < 1e-4


def test_invalid_cutoffs_are_rejected_and_short_signals_are_not() -> None:
    for cutoff in (0.0, 50.0, float("nan")):
        with pytest.raises(ValueError, match=r"cutoff is .* Hz, expected between 0 and half the sampling rate, 50 Hz"):
            low_pass(sinusoid(1.0), RATE, cutoff)
    assert low_pass(np.zeros((16, 2)), RATE).shape == (16, 2)


def test_differentiate_is_exact_on_quadratics() -> None:
    t = np.arange(7)[:, None] / RATE
    signal = np.hstack([3 - 2 * t + 5 * t**2, 7 * t, np.ones_like(t)])
    expected = np.hstack([-2 + 10 * t, np.full_like(t, 7), np.zeros_like(t)])
    assert np.allclose(differentiate(signal, RATE), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("std", [1e-3, 0.05, 1.0])
def test_noise_level_of_a_noisy_sinusoid(std: float) -> None:
    rng = np.random.default_rng(0)
    clean = np.hstack([5 * sinusoid(0.5), 0.1 * sinusoid(1.5), 0 * sinusoid(1.0)])
    noisy = clean + std * rng.standard_normal(clean.shape)
    level = noise_level([noisy[:700], 50 + noisy[700:]])  # a jump between episodes does not count as noise
    assert np.allclose(level, std, rtol=0.15)


def test_noise_level_of_short_recordings_is_tenth_of_spread() -> None:
    episodes = [np.array([[0.0], [1.0]]), np.array([[2.0]])]
    assert noise_level(episodes)[0] == pytest.approx(0.1 * np.std([0.0, 1.0, 2.0]))


@pytest.mark.parametrize("rate", [100.0, 250.0, 1000.0])
def test_weight_per_second_is_equal_at_every_rate(rate: float) -> None:
    time = 1e9 + np.arange(int(4 * rate)) / rate
    assert stream_weights(time).sum() == pytest.approx(4 * INDEPENDENT_HZ, rel=1e-3)
    assert stream_weights(time[1:], time[0]).sum() == pytest.approx((4 - 1 / rate) * INDEPENDENT_HZ, rel=1e-3)


def test_rows_of_a_slow_stream_have_full_weight() -> None:
    assert (stream_weights(np.arange(5) / INDEPENDENT_HZ) > 1 - 1e-12).all()
    assert (stream_weights(np.arange(5) / 2.0) == 1).all()
    assert (stream_weights(np.array([3.0])) == 1).all()
    assert (stream_weights(np.array([3.0]), 2.0) == 1).all()


def test_wrong_time_does_not_change_even_weights() -> None:
    time = 5.0 + np.arange(20) / 500
    expected = np.full(20, INDEPENDENT_HZ / 500)
    np.testing.assert_allclose(even_weights(time), expected)
    for wrong in (np.nan, 4.0, 1e9, time[6]):
        np.testing.assert_allclose(even_weights(np.where(np.arange(20) == 7, wrong, time)), expected, rtol=1e-9)
    assert (even_weights(np.array([3.0])) == 1).all()
    assert (even_weights(np.arange(5.0)) == 1).all()


def test_bunched_rows_share_the_weight_of_their_time() -> None:
    """Ten frames that arrive together stand for the ten milliseconds since the previous ones."""
    even = np.arange(1, 201) / 1000
    bunched = np.repeat(even[9::10], 10) + np.tile(np.arange(10), 20) * 1e-6
    assert stream_weights(bunched, 0.0).sum() == pytest.approx(stream_weights(even, 0.0).sum(), rel=1e-2)


def test_rows_without_times_share_time_since_previous_batch() -> None:
    together = stream_weights(np.full(100, 7.0), 6.9)
    assert (together == together[0]).all()
    assert together.sum() == pytest.approx(0.1 * INDEPENDENT_HZ)
    assert (stream_weights(np.full(100, 7.0)) == 1).all()


def test_backward_time_has_no_weight() -> None:
    assert stream_weights(np.array([3.0]), 4.0)[0] == 0
    assert len(stream_weights(np.empty(0))) == 0


@given(st.permutations(range(8)))
def test_weights_follow_rows_in_any_order(order: list[int]) -> None:
    time = np.cumsum([0.001, 0.002, 0.001, 0.05, 0.003, 0.001, 0.001, 0.01])
    np.testing.assert_allclose(stream_weights(time[order], 0.0), stream_weights(time, 0.0)[order])


@pytest.mark.parametrize("rate", [1000.0, 100.0, 8.0])
def test_recording_rows_are_weighted_by_their_time(rate: float) -> None:
    time = np.r_[np.arange(50) / rate, 5 + np.arange(50) / rate, 9.0]
    episode = np.r_[np.zeros(50), np.ones(50), 2].astype(np.int64)
    found = recording_weights(time, episode)
    np.testing.assert_allclose(found, np.r_[np.full(100, min(1.0, 10 / rate)), 1.0], rtol=1e-9)
    # a piece with one more row at both ends has the same weights as the whole
    np.testing.assert_array_equal(recording_weights(time[29:72], episode[29:72])[1:-1], found[30:71])
    assert len(recording_weights(np.empty(0), np.empty(0, np.int64))) == 0
