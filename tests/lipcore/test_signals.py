"""Zero-phase filtering, differentiation, and reading the noise off a signal."""

from __future__ import annotations

import numpy as np
import pytest

from lipcore.data.signals import differentiate, low_pass, noise_level

RATE = 100.0
SECONDS = 20
INTERIOR = slice(300, -300)
"""Away from the ends, over whole periods of every frequency used here."""


def phasor(signal: np.ndarray, frequency: float) -> complex:
    """Gain and phase against sin(2π f t), from whole periods."""
    t = np.arange(len(signal)) / RATE
    return complex(2 * np.mean(signal[INTERIOR] * np.exp(-2j * np.pi * frequency * t[INTERIOR])) * 1j)


def sinusoid(frequency: float) -> np.ndarray:
    return np.sin(2 * np.pi * frequency * np.arange(int(SECONDS * RATE)) / RATE)[:, None]


@pytest.mark.parametrize("frequency", [0.5, 1.0, 2.0, 4.0])
def test_low_pass_does_not_delay(frequency: float) -> None:
    answer = phasor(low_pass(sinusoid(frequency), RATE)[:, 0], frequency)
    assert abs(np.angle(answer)) < 1e-3


def test_low_pass_keeps_what_is_slow_halves_the_cut_off_and_removes_what_is_fast() -> None:
    gain = {f: abs(phasor(low_pass(sinusoid(f), RATE, cutoff=4.0)[:, 0], f)) for f in (1.0, 4.0, 8.0, 16.0)}
    assert gain[1.0] == pytest.approx(1.0, abs=1e-3)
    # each of the two passes leaves 1/√2 at the cut-off
    assert gain[4.0] == pytest.approx(0.5, abs=1e-3)
    assert gain[8.0] < 0.01
    assert gain[16.0] < 1e-4


def test_low_pass_filters_columns_alone_and_keeps_constants() -> None:
    both = low_pass(np.hstack([sinusoid(1.0), np.full((2000, 1), 3.0)]), RATE)
    assert np.allclose(both[:, :1], low_pass(sinusoid(1.0), RATE), rtol=0, atol=1e-14)
    assert np.allclose(both[:, 1], 3.0, rtol=1e-9)


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 50.0, float("nan")])
def test_impossible_cut_off_is_refused(cutoff: float) -> None:
    with pytest.raises(ValueError, match=r"cutoff is .* Hz, expected between 0 and half the sampling rate, 50 Hz"):
        low_pass(sinusoid(1.0), RATE, cutoff)


def test_signal_too_short_to_be_filtered_is_refused_and_the_shortest_is_not() -> None:
    with pytest.raises(ValueError, match="signal has 15 samples, expected at least 16"):
        low_pass(np.zeros((15, 2)), RATE)
    assert low_pass(np.zeros((16, 2)), RATE).shape == (16, 2)


def test_differentiate_is_exact_on_quadratics_up_to_both_ends() -> None:
    t = np.arange(7)[:, None] / RATE
    signal = np.hstack([3 - 2 * t + 5 * t**2, 7 * t, np.ones_like(t)])
    expected = np.hstack([-2 + 10 * t, np.full_like(t, 7), np.zeros_like(t)])
    assert np.allclose(differentiate(signal, RATE), expected, rtol=0, atol=1e-11)


def test_signal_too_short_to_be_differentiated_is_refused() -> None:
    with pytest.raises(ValueError, match="signal has 2 samples, expected at least 3"):
        differentiate(np.zeros((2, 1)), RATE)


@pytest.mark.parametrize("std", [1e-3, 0.05, 1.0])
def test_noise_level_of_a_noisy_sinusoid(std: float) -> None:
    rng = np.random.default_rng(0)
    clean = np.hstack([5 * sinusoid(0.5), 0.1 * sinusoid(1.5), 0 * sinusoid(1.0)])
    level = noise_level([clean + std * rng.standard_normal(clean.shape)])
    assert np.allclose(level, std, rtol=0.15)


def test_jumps_between_episodes_are_no_noise() -> None:
    rng = np.random.default_rng(1)
    episodes = [offset + 0.01 * rng.standard_normal((200, 1)) for offset in (0.0, 50.0, -50.0)]
    assert noise_level(episodes)[0] == pytest.approx(0.01, rel=0.15)


def test_noise_level_of_recordings_too_short_to_tell_is_a_tenth_of_the_spread() -> None:
    episodes = [np.array([[0.0], [1.0]]), np.array([[2.0]])]
    assert noise_level(episodes)[0] == pytest.approx(0.1 * np.std([0.0, 1.0, 2.0]))
