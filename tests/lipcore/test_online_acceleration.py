"""Accelerations derived from a live stream against true ones."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lipcore.online.acceleration import RateError, derive, rate_of, window

EPOCH = 1.8e9
"""Unix time, whose floats step by 2.4e-7 s."""


def gain(frequency: float, rate: float) -> complex:
    """Derived over true acceleration of a sinusoid, from whole periods."""
    half = window(rate)
    t = np.arange(round(10 * rate) + 2 * half) / rate
    derived = derive(t, np.sin(2 * np.pi * frequency * t)[:, None], half)
    wave = np.exp(-2j * np.pi * frequency * t[half:-half])
    return complex(2 * np.mean(derived.ddq[:, 0] * wave) / (2 * np.pi * frequency))


# 3 (sin x − x cos x)/x³ at T = 0.04 s, worked out by hand; the sum over few samples differs by less than 0.02
@pytest.mark.parametrize(("frequency", "expected"), [(1.0, 0.994), (2.0, 0.975), (4.0, 0.903), (9.94, 0.5)])
def test_gain_falls_as_stated_without_phase_shift(frequency: float, expected: float) -> None:
    # whole periods in 10 s
    frequency = round(frequency * 10) / 10
    assert abs(gain(frequency, 1000.0) - expected) < 0.01
    assert abs(np.angle(gain(frequency, 100.0))) < 1e-9


def test_noise_comes_out_as_stated() -> None:
    rng = np.random.default_rng(2)
    for rate, stated in ((1000.0, 4.8), (100.0, 13.0), (50.0, 16.0)):
        t = np.arange(20_000) / rate
        derived = derive(t, rng.standard_normal((20_000, 1)), window(rate))
        assert derived.ddq.std() == pytest.approx(stated, rel=0.05)


@given(
    coefficients=st.tuples(*[st.floats(-10, 10)] * 3),
    half=st.integers(1, 6),
    extra=st.integers(-1, 5),
    rate=st.integers(50, 1000),
)
@example(coefficients=(1.0, 1.0, 1.0), half=4, extra=-1, rate=100)
@settings(deadline=None)
def test_exact_on_quadratics_and_as_late_as_stated(
    coefficients: tuple[float, float, float], half: int, extra: int, rate: int
) -> None:
    a, b, c = coefficients
    t = np.arange(2 * half + 1 + extra) / rate
    derived = derive(t, (a + b * t + c * t**2)[:, None], half)
    assert derived.first == half
    assert derived.delay_s == pytest.approx(half / rate)
    assert derived.ddq.shape == (1 + extra, 1)
    assert np.allclose(derived.ddq[:, 0], (b + 2 * c * t)[half : half + 1 + extra], rtol=0, atol=1e-8)


@given(cut=st.integers(5, 55), half=st.integers(1, 4))
@settings(deadline=None)
def test_batches_that_carry_over_twice_half_rows_give_what_the_whole_gives(cut: int, half: int) -> None:
    rng = np.random.default_rng(cut)
    t, dq = np.arange(60) / 100.0, rng.standard_normal((60, 2))
    whole = derive(t, dq, half).ddq
    cut = max(cut, 2 * half + 1)
    first = derive(t[:cut], dq[:cut], half)
    second = derive(t[cut - 2 * half :], dq[cut - 2 * half :], half)
    assert np.allclose(np.concatenate([first.ddq, second.ddq]), whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize("rate", [50.0, 100.0, 333.0, 1000.0])
def test_rate_is_read_off_unix_times_that_waver(rate: float) -> None:
    rng = np.random.default_rng(4)
    t = EPOCH + (np.arange(200) + rng.uniform(-0.09, 0.09, 200)) / rate
    assert rate_of(t) == pytest.approx(rate, rel=2e-3)


@pytest.mark.parametrize(
    ("t", "message"),
    [
        (np.delete(np.arange(20) / 100, 7), r"t\[7\] is 0.02 s after the time before it, expected steps of 0.01 s"),
        (np.zeros(5), "t has a median step of 0 s"),
        (np.zeros(1), "t has 1 times"),
        (np.arange(9) / 47.0, "the rate is 47 Hz, expected at least 50 Hz"),
    ],
)
def test_times_without_a_rate_are_refused(t: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rate_of(t)
    with pytest.raises(RateError, match="the rate is 10 Hz, expected at least 50 Hz"):
        window(10.0)


@pytest.mark.parametrize(
    ("shape", "half", "message"),
    [((9, 2), 0, "half is 0"), ((8, 2), 2, r"dq has shape \(8, 2\)"), ((9,), 2, r"dq has shape \(9,\)")],
)
def test_what_cannot_be_derived_is_named(shape: tuple[int, ...], half: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        derive(np.arange(9) / 100.0, np.zeros(shape), half)
