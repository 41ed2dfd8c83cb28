"""Derive accelerations from a live stream's velocities: a local slope with a known delay, across batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.gates import RowLimits, check_rows
from lipcore.vocabulary import Code

MIN_RATE_HZ = 50.0
RATE_SLACK = 0.95
"""A clock with a nominal rate of 50 Hz may run 5 % slow."""
MAX_JITTER_SHARE = 0.2
"""Max deviation of a time step from the median step."""
HALF_WINDOW_S = 0.04
MIN_HALF_ROWS = 2


class RateError(ValueError):
    """The stream is too slow to derive accelerations."""


class DerivationError(ValueError):
    """The accelerations of a batch cannot be derived: `field` has `value`, but `expected` is needed."""

    def __init__(self, field: str, value: str, expected: str, message: str) -> None:
        super().__init__(message)
        self.field, self.value, self.expected = field, value, expected


@dataclass(frozen=True)
class DerivedAccelerations:
    """ddq: (M, n) rad/s² (m/s²) of the rows first … first + M − 1, known delay_s seconds after each row."""

    first: int
    ddq: Array
    delay_s: float


def rate_of(t: Array) -> float:
    """Return the sampling rate, Hz, of times (N,) s, N ≥ 2.

    Raise ValueError if a step differs from the median step by more than 20 % (or time stands still), and RateError
    below MIN_RATE_HZ.
    """
    if len(t) < 2:
        raise ValueError(f"t has {len(t)} times, expected at least 2")
    steps = np.diff(t)
    usual = float(np.median(steps))
    if not usual > 0:
        raise ValueError(f"t has a median step of {usual:g} s, expected one above 0")
    deviation = np.abs(steps / usual - 1)
    worst = int(deviation.argmax())
    if not deviation[worst] <= MAX_JITTER_SHARE:
        raise ValueError(
            f"t[{worst + 1}] is {steps[worst]:g} s after the time before it, expected steps of {usual:g} s within "
            f"{MAX_JITTER_SHARE:.0%}, since accelerations must be derived"
        )
    rate = (len(t) - 1) / float(t[-1] - t[0])
    _check_rate(rate)
    return rate


def window(rate: float) -> int:
    """Return the half width h of the window for accelerations at `rate` Hz, in samples.

    Raise RateError if the rate is too low.

    h is 0.04 s, at least 2 samples. The slope over ±T passes a motion of frequency f with the gain 3 (sin x − x cos
    x)/x³ ≈ 1 − x²/10, x = 2π f T. At T = 0.04 s the gain is 0.994 at 1 Hz, 0.975 at 2 Hz, 0.903 at 4 Hz, 1/√2 at 7.2 Hz
    and 1/2 at 10 Hz. (The zero-phase filter for recordings, data.signals.CUTOFF, is flatter below and falls to 1/2 at 4
    Hz; a local quadratic as narrow would lose 4 % at 1 Hz.) White noise σ on dq gives σ rate √(3/(h (h+1) (2h+1))) ≈ σ
    √(3/(2 T³ rate)): 4.8 σ/s at 1 kHz, 13 σ/s at 100 Hz, 16 σ/s at 50 Hz.

    Measured on a Panda moving at up to 1.6 Hz (ddq of 2 rad/s² rms), σ = 1e-3 rad/s, as root mean squared error over
    that of ddq: 1.2 % at 1 kHz, 1.5 % at 100 Hz, 1.8 % at 50 Hz. T = 0.05 s gave 1.7 to 2.0 % at these rates. Two
    samples on either side give 6 % at 25 Hz and 33 % at 10 Hz, too much for rigid-body torques: hence MIN_RATE_HZ.
    """
    _check_rate(rate)
    return max(MIN_HALF_ROWS, round(HALF_WINDOW_S * rate))


def derive(t: Array, dq: Array, half: int) -> DerivedAccelerations:
    """Return the slope of the quadratic through the 2·half + 1 velocities around each row (Savitzky–Golay).

    ddq_k = Σ_j j dq_{k+j} / (dt Σ_j j²), j = −half … half. It is exact on quadratics, has no phase shift, and uses no
    row later than its delay, half·dt. t: (N,) s, evenly spaced (`rate_of`); dq: (N, n), finite. Fewer than 2·half + 1
    rows give none. Steps count as equal: a controller samples more evenly than its time stamps show. Raise ValueError
    if shapes differ or times are uneven, RateError if the rate is too low.
    """
    if half < 1:
        raise ValueError(f"half is {half}, expected at least 1")
    if dq.ndim != 2 or t.shape != dq.shape[:1]:
        raise ValueError(f"dq has shape {dq.shape}, expected (N, n) with N = {len(t)}, the length of t")
    rate = rate_of(t)
    width = 2 * half + 1
    offsets = np.arange(-half, half + 1, dtype=np.float64)
    weights = offsets * rate / (offsets @ offsets)
    if len(t) < width:
        return DerivedAccelerations(half, np.empty((0, dq.shape[1])), half / rate)
    # (N - 2 half, n, width): each row's neighbourhood, without copying
    around = np.lib.stride_tricks.sliding_window_view(dq, width, axis=0)
    return DerivedAccelerations(half, np.asarray(around @ weights), half / rate)


def _check_rate(rate: float) -> None:
    if not rate >= RATE_SLACK * MIN_RATE_HZ:
        raise RateError(
            f"the rate is {rate:.3g} Hz, expected at least {MIN_RATE_HZ:g} Hz to derive accelerations; send ddq instead"
        )


@dataclass(frozen=True)
class Derivation:
    """How accelerations of a batch are derived: from `half` rows on either side of each, at `rate` rows per second."""

    half: int
    rate: float

    @property
    def delay_s(self) -> float:
        """Return the delay from a row to its acceleration, s."""
        return self.half / self.rate

    @staticmethod
    def of(t: Array, half: int | None) -> Derivation:
        """Return the derivation of a batch with times (N,), s, by its stream's clock; raise DerivationError.

        half: of the neighbouring batch, None without one: a stream has one window, even if its measured rate varies.
        """
        rate = _batch_rate(t)
        return Derivation(half or window(rate), rate)


@dataclass(frozen=True)
class DerivedRows:
    """Rows of a batch with accelerations, and `carried` rows of earlier batches that it completes.

    own: places of the batch's own rows.
    """

    rows: Rows
    own: slice
    carried: int


def derive_rows(
    rows: Rows, how: Derivation, before: Sequence[Rows], after: Sequence[Rows], limits: RowLimits
) -> DerivedRows:
    """Derive the accelerations of a batch across its neighbours in the stream; `ddq` of the rows is ignored.

    An acceleration needs the velocities of `half` rows on either side. At the ends of a batch these belong to the
    batches before and after, of which 2·half rows suffice. A row waits, coded `edge`, until both are there, in whatever
    order. It is decided with the later one. It is thus learnt exactly once, as if the stream were one batch.
    """
    everything = Rows.concatenate([*before, rows, *after])
    own = np.zeros(len(everything), np.bool_)
    first = sum(map(len, before))
    own[first : first + len(rows)] = True
    everything = replace(everything, ddq=_slopes(everything, how))
    known = np.isfinite(everything.ddq).all(axis=1)
    codes = everything.code.copy()
    # with 2 half rows on either side, every complete window includes rows of the batch: none was complete before
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
    """Return the rows per second in the longest stretch without a gap; event time is too coarse for this (0.2 µs).

    Raise DerivationError if accelerations cannot be derived at this rate, or if steps of time are too uneven.
    """
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        message = f"`t` has {len(finite)} times; at least 2 are needed to derive `ddq`."
        raise DerivationError("t", f"{len(finite)} times", "at least 2 times", message)
    steps = np.diff(finite)
    rising = steps[steps > 0]
    step = float(np.median(rising)) if len(rising) else 0.0
    run = max(_runs(t, np.isfinite(t), step), key=len)
    if len(run) < 2 or 2 * np.count_nonzero(_even(steps, step)) < len(steps):
        spread = f"steps from {steps.min():.3g} to {steps.max():.3g} s"
        expected = f"steps that differ by at most {100 * MAX_JITTER_SHARE:.0f} %"
        message = f"`ddq` cannot be derived, because `t` is uneven: it has {spread}, expected {expected}."
        raise DerivationError("t", f"uneven, with {spread}", expected, message)
    rate = (len(run) - 1) / float(t[run[-1]] - t[run[0]])
    try:
        window(rate * (1 - 1e-9))  # rounding must not change the result later
    except RateError:
        given, expected = f"{rate:.3g} rows per second", f"at least {MIN_RATE_HZ:g} rows per second"
        message = f"`ddq` cannot be derived from {given}: send `ddq`, or {expected}."
        raise DerivationError("ddq", f"missing, with {given}", f"accelerations, or {expected}", message) from None
    return rate


def _runs(t: Array, usable: NDArray[np.bool_], step: float) -> list[NDArray[np.int64]]:
    """Return the places of evenly spaced rows, run after run."""
    joined = usable[:-1] & usable[1:]
    joined[joined] = _even(t[1:][joined] - t[:-1][joined], step)
    return np.split(np.arange(len(t)), np.flatnonzero(~joined) + 1)


def _even(steps: Array, step: float) -> NDArray[np.bool_]:
    return np.asarray((steps > 0) & (np.abs(steps - step) <= MAX_JITTER_SHARE * step))


def _slopes(rows: Rows, how: Derivation) -> Array:
    """Return the accelerations, (N, n), of all rows in the middle of 2·half + 1 even ones, NaN for the others."""
    ddq = np.full_like(rows.dq, np.nan)
    usable = np.isfinite(rows.time) & np.isfinite(rows.dq).all(axis=1)
    for run in _runs(rows.time, usable, 1 / how.rate):
        if len(run) > 2 * how.half:
            # a controller samples more evenly than it stamps, and event time is coarse
            slopes = derive(np.arange(len(run)) / how.rate, rows.dq[run], how.half)
            ddq[run[slopes.first : slopes.first + len(slopes.ddq)]] = slopes.ddq
    return ddq
