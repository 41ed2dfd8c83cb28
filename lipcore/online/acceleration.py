"""Accelerations from measured velocities of a live stream: a local slope, late by a known delay; and those of a batch
that was sent without, across the batches next to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.gates import RowLimits, check_rows
from lipcore.vocabulary import Code

MIN_RATE = 50.0
RATE_SLACK = 0.95
"""A clock that is to tick at 50 Hz may run up to 5 % slow."""
JITTER = 0.2
"""Largest deviation of a step of time from the usual one."""
HALF_WINDOW_S = 0.04
MIN_HALF = 2


class RateError(ValueError):
    """The stream is too slow to derive accelerations from."""


class DerivationError(ValueError):
    """Accelerations of a batch cannot be derived: `field` has `value`, and `expected` says what is needed."""

    def __init__(self, field: str, value: str, expected: str) -> None:
        super().__init__(f"{field} is {value}, expected {expected}")
        self.field, self.value, self.expected = field, value, expected


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


@dataclass(frozen=True)
class Derivation:
    """How the accelerations of a batch are derived: from `half` rows on either side of a row, of `rate` rows a second.

    An acceleration is known `delay_s` later than its row."""

    half: int
    rate: float

    @property
    def delay_s(self) -> float:
        """How much later than its row an acceleration is known, s."""
        return self.half / self.rate

    @staticmethod
    def of(t: Array, half: int | None) -> Derivation:
        """Return that of a batch with times (N,), s, by its stream's clock. half: of the batch next to it, None without
        one: a stream has one window, however its rate is measured. Raise DerivationError."""
        rate = _batch_rate(t)
        return Derivation(half or window(rate), rate)


@dataclass(frozen=True)
class DerivedRows:
    """rows: those of a batch with accelerations, and rows of others that it completes; own: places of the batch's;
    carried: how many rows of others."""

    rows: Rows
    own: slice
    carried: int


def derive_rows(
    rows: Rows, how: Derivation, before: Sequence[Rows], after: Sequence[Rows], limits: RowLimits
) -> DerivedRows:
    """Derive the accelerations of a batch of rows, whose `ddq` is ignored, across the batches next to it in its stream.

    An acceleration stands on the velocities of `half` rows on either side of its row. At the ends of a batch they are
    those of the batches before and after, of which 2·half rows suffice. A row waits, coded `edge`, until both are
    there, in whatever order; it is decided with the later one, so that it is learnt exactly once, and as if the stream
    were one batch.
    """
    everything = Rows.concatenate([*before, rows, *after])
    own = np.zeros(len(everything), np.bool_)
    first = sum(map(len, before))
    own[first : first + len(rows)] = True
    everything = replace(everything, ddq=_slopes(everything, how))
    known = np.isfinite(everything.ddq).all(axis=1)
    codes = everything.code.copy()
    # 2 half rows on either side are so few that every window that is complete reaches into the batch: none was before
    decided = known & ~own & (codes == Code.EDGE)
    codes[~known & (codes == Code.LEARNT)] = Code.EDGE
    codes[decided] = Code.LEARNT
    fresh = codes == Code.LEARNT
    again = everything.take(fresh)
    codes[fresh] = check_rows(None, again.q, again.dq, again.ddq, again.tau, limits)
    start = int(decided[:first].sum())
    return DerivedRows(
        replace(everything, code=codes).take(decided | own), slice(start, start + len(rows)), int(decided.sum())
    )


def _batch_rate(t: Array) -> float:
    """Rows a second, in the longest stretch without a gap: event time is too coarse to tell, to 0.2 µs today. Raise
    DerivationError if accelerations cannot be derived at this rate, or time is too uneven."""
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        raise DerivationError("t", f"{len(finite)} times", "at least 2 rows with times, to derive ddq from dq with")
    steps = np.diff(finite)
    rising = steps[steps > 0]
    step = float(np.median(rising)) if len(rising) else 0.0
    run = max(_runs(t, np.isfinite(t), step), key=len)
    if len(run) < 2 or 2 * np.count_nonzero(_even(steps, step)) < len(steps):
        spread = f"uneven, with steps from {steps.min():.3g} to {steps.max():.3g} s"
        raise DerivationError(
            "t", spread, f"steps that differ by at most {100 * JITTER:.0f} %, to derive ddq from dq with"
        )
    rate = (len(run) - 1) / float(t[run[-1]] - t[run[0]])
    try:
        window(rate * (1 - 1e-9))  # so that rounding leads to no other answer later
    except RateError:
        expected = f"measured accelerations, or at least {MIN_RATE:g} rows a second to derive them from"
        raise DerivationError("ddq", f"missing, with {rate:.3g} rows a second", expected) from None
    return rate


def _runs(t: Array, usable: NDArray[np.bool_], step: float) -> list[NDArray[np.int64]]:
    """Places of rows that follow each other evenly, run after run."""
    joined = usable[:-1] & usable[1:]
    joined[joined] = _even(t[1:][joined] - t[:-1][joined], step)
    return np.split(np.arange(len(t)), np.flatnonzero(~joined) + 1)


def _even(steps: Array, step: float) -> NDArray[np.bool_]:
    return np.asarray((steps > 0) & (np.abs(steps - step) <= JITTER * step))


def _slopes(rows: Rows, how: Derivation) -> Array:
    """Accelerations of all rows in the middle of 2·half + 1 even ones, NaN for the others: (N, n)."""
    ddq = np.full_like(rows.dq, np.nan)
    usable = np.isfinite(rows.time) & np.isfinite(rows.dq).all(axis=1)
    for run in _runs(rows.time, usable, 1 / how.rate):
        if len(run) > 2 * how.half:
            # a controller samples more evenly than it stamps, and event time is coarse
            slopes = derive(np.arange(len(run)) / how.rate, rows.dq[run], how.half)
            ddq[run[slopes.first : slopes.first + len(slopes.ddq)]] = slopes.ddq
    return ddq
