"""Accelerations from measured velocities of a live stream: a local slope, late by a known delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array

MIN_RATE = 50.0
RATE_SLACK = 0.95
"""A clock that is to tick at 50 Hz may run up to 5 % slow."""
JITTER = 0.2
"""Largest deviation of a step of time from the usual one."""
HALF_WINDOW_S = 0.04
MIN_HALF = 2


class RateError(ValueError):
    """The stream is too slow to derive accelerations from."""


@dataclass(frozen=True)
class Derived:
    """ddq: (M, n) rad/s² (m/s²) of the rows first … first + M − 1, known delay_s seconds after each."""

    first: int
    ddq: Array
    delay_s: float


def rate_of(t: Array) -> float:
    """Sampling rate, Hz, of times (N,) s, N ≥ 2.

    Raise ValueError where a step differs from the median step by more than 20 % (or time stands), and RateError below
    MIN_RATE.
    """
    if len(t) < 2:
        raise ValueError(f"t has {len(t)} times, expected at least 2 to tell a rate")
    steps = np.diff(t)
    usual = float(np.median(steps))
    if not usual > 0:
        raise ValueError(f"t has a median step of {usual:g} s, expected one above 0")
    deviation = np.abs(steps / usual - 1)
    worst = int(deviation.argmax())
    if not deviation[worst] <= JITTER:
        raise ValueError(
            f"t[{worst + 1}] is {steps[worst]:g} s after the time before it, expected steps of {usual:g} s within "
            f"{JITTER:.0%}, since accelerations must be derived"
        )
    rate = (len(t) - 1) / float(t[-1] - t[0])
    _check_rate(rate)
    return rate


def window(rate: float) -> int:
    """Half width h, in samples, of the window that accelerations are derived with at `rate` Hz; RateError if too slow.

    h is 0.04 s, at least 2 samples. The slope over ±T passes a motion of frequency f with the gain
    3 (sin x − x cos x)/x³ ≈ 1 − x²/10, x = 2π f T, which at T = 0.04 s is 0.994 at 1 Hz, 0.975 at 2 Hz, 0.903 at 4 Hz,
    1/√2 at 7.2 Hz and 1/2 at 10 Hz. (The zero-phase filter for recordings, data.signals.CUTOFF, is flatter below and
    down to 1/2 at 4 Hz; a local quadratic as narrow as that would lose 4 % at 1 Hz.) White noise σ on dq comes out as
    σ rate √(3/(h (h+1) (2h+1))) ≈ σ √(3/(2 T³ rate)): 4.8 σ/s at 1 kHz, 13 σ/s at 100 Hz, 16 σ/s at 50 Hz.

    Measured on a Panda moving at up to 1.6 Hz (ddq of 2 rad/s² rms), σ = 1e-3 rad/s, as root mean squared error over
    that of ddq: 1.2 % at 1 kHz, 1.5 % at 100 Hz, 1.8 % at 50 Hz. T = 0.05 s gave 1.7 to 2.0 % at these rates. Two
    samples either side at 25 Hz give 6 % and at 10 Hz 33 %, beyond what rigid-body torques allow: hence MIN_RATE.
    """
    _check_rate(rate)
    return max(MIN_HALF, round(HALF_WINDOW_S * rate))


def derive(t: Array, dq: Array, half: int) -> Derived:
    """Slope of the least-squares quadratic through the 2·half + 1 velocities around each row (Savitzky–Golay).

    ddq_k = Σ_j j dq_{k+j} / (dt Σ_j j²), j = −half … half: exact on quadratics, without phase shift, and using nothing
    later than half·dt, which is its delay. t: (N,) s, evenly spaced (`rate_of`); dq: (N, n), finite. No rows come out
    of fewer than 2·half + 1. Steps count as equal: samples are taken by a controller's clock more evenly than stamped.
    Raise ValueError where shapes differ or times are uneven, RateError where they are too far apart.
    """
    if half < 1:
        raise ValueError(f"half is {half}, expected at least 1")
    if dq.ndim != 2 or t.shape != dq.shape[:1]:
        raise ValueError(f"dq has shape {dq.shape}, expected (N, n) with N = {len(t)} as t has")
    rate = rate_of(t)
    width = 2 * half + 1
    offsets = np.arange(-half, half + 1, dtype=np.float64)
    weights = offsets * rate / (offsets @ offsets)
    if len(t) < width:
        return Derived(half, np.empty((0, dq.shape[1])), half / rate)
    # (N - 2 half, n, width): each row's neighbourhood, without copying
    around = np.lib.stride_tricks.sliding_window_view(dq, width, axis=0)
    return Derived(half, np.asarray(around @ weights), half / rate)


def _check_rate(rate: float) -> None:
    if not rate >= RATE_SLACK * MIN_RATE:
        raise RateError(
            f"the rate is {rate:.3g} Hz, expected at least {MIN_RATE:g} Hz to derive accelerations; send ddq instead"
        )
