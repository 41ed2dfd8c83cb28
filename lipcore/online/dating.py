"""Date the rows of a batch in event time: Unix time, counted by the stream's own clock.

The offset of a stream is fixed once, so that the last row of its first batch lies at the arrival of that batch. It is 0
until a batch of the stream has times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.online.batch import Placement, Rows
from lipcore.online.gates import RowLimits, check_rows, time_span
from lipcore.vocabulary import Code

MAX_AHEAD_S = 86400.0
"""Max time by which a row may be dated after its arrival, s: the max length of a recording sent at once."""


LEAP_S = 60.0
"""Min jump ahead of the arrival, s, that proves a clock wrong: so much time has not passed. A recording that is sent
faster than it was measured gets as far ahead in small steps."""
MAX_AGE_TIME_CONSTANTS = 7.0
"""Age, in time constants of forgetting, at which a row has a weight of a thousandth and is rejected."""


@dataclass(frozen=True)
class MeasuredRows:
    """N rows as measured, in the model's joint order. t: (N,) by the stream's clock, s; the others (N, n), SI."""

    t: Array | None
    q: Array
    dq: Array
    ddq: Array | None
    tau: Array

    def __len__(self) -> int:
        return len(self.q)


@dataclass(frozen=True)
class StreamTime:
    """What is known of a stream's time when a batch arrives."""

    offset: float | None
    """The offset of the stream, s; None while it is unknown."""
    after: float | None
    """Time, by the stream's clock, after which the rows must lie."""
    before: float | None
    """Time, by the stream's clock, before which the rows must lie."""
    adjacent: bool
    """Whether `after` is the time of the row right before the batch."""
    arrived: float
    """When the batch arrived, Unix time, s."""

    @staticmethod
    def of(
        offset: float, before: Placement | None, after: Placement | None, adjacent: bool, arrived: float
    ) -> StreamTime:
        """Return the clock of a stream.

        offset: s, 0 while it is unknown; before, after: the stored batches next below and above the sequence; adjacent:
        whether the one below has the previous sequence.
        """
        latest = arrived + MAX_AHEAD_S - offset if offset else None
        last = None if before is None or before.span is None else before.span[1]
        first = None if after is None or after.span is None else after.span[0]
        bounds = [bound for bound in (latest, first) if bound is not None]
        return StreamTime(offset or None, last, min(bounds, default=None), adjacent, arrived)

    def fix_offset(self, t: Array | None, usable: NDArray[np.bool_], gap: float) -> float:
        """Return the offset, s; it is fixed by the first rows with times. usable: rows with a plausible time, (N,)."""
        if self.offset is not None:
            return self.offset
        if t is None or not usable.any():
            return 0.0
        times = t[usable]
        runs = np.split(times, np.flatnonzero(np.diff(times) > gap) + 1)
        # one wrong time at the end, far from all others, must not fix the offset
        last = next((run for run in reversed(runs) if len(run) > 1), runs[-1])
        return self.arrived - float(last[-1])

    def find_stray_times(self, t: Array, usable: NDArray[np.bool_], offset: float, gap: float) -> NDArray[np.bool_]:
        """Return the rows, (N,), with an isolated time in the future: between gaps, or between a gap and the end.

        Such a time is most likely wrong: if it were accepted, all later rows would be late.
        """
        leaping = np.zeros(len(t), dtype=np.bool_)
        times = t[usable]
        start = self.after if self.adjacent and self.after is not None else times[:1]
        after_gap = np.diff(times, prepend=start) > gap
        alone = after_gap & np.append(after_gap[1:], True)
        leaping[usable] = alone[: len(times)] & (times + offset > self.arrived + gap)
        return leaping

    def find_leap(self, t: Array, usable: NDArray[np.bool_], offset: float, gap: float) -> tuple[int, float] | None:
        """Return the row at which the clock has jumped ahead of the arrival, and how far, s; None if it has not."""
        places = np.flatnonzero(usable)
        ahead = t[places] + offset - self.arrived
        first = ahead[:1] if self.after is None else self.after + offset - self.arrived
        before = np.append(first, ahead[:-1])[: len(ahead)]
        leapt = np.flatnonzero((ahead > LEAP_S) & (before <= LEAP_S) & (ahead - before > gap))
        return (int(places[leapt[0]]), float(ahead[leapt[0]])) if len(leapt) else None

    def event_time(self, t: Array | None, offset: float, rows: int) -> Array:
        """Return finite event times (N,), s: a row without a time gets that of the row before it."""
        if t is None:
            return np.full(rows, self.arrived)
        known = np.isfinite(t)
        place = np.maximum.accumulate(np.where(known, np.arange(rows), 0))
        times = t[place] + offset
        return np.where(np.isfinite(times), times, self.arrived)


@dataclass(frozen=True)
class DatedRows:
    """Rows with event times and the codes of `check_rows`."""

    rows: Rows
    offset: float
    """The offset of the stream, s."""
    span: tuple[float, float] | None
    """First and last time of the batch by its stream's clock; neighbouring batches lie before and after."""
    leap: float | None
    """How far its clock has jumped ahead of the arrival, s; None if it has not."""


def date_rows(
    measured: MeasuredRows,
    clock: StreamTime,
    bounds: RowLimits,
    previous: float | None,
    forgetting_s: float | None = None,
) -> DatedRows:
    """Check, date and weigh rows.

    previous: event time of the row right before them, s, if known; forgetting_s: of the model. Weights are computed
    from the batch itself if it has a spacing, so that they do not depend on the order of arrival.
    """
    t = measured.t
    numbers = measured.q, measured.dq, measured.ddq, measured.tau
    codes = check_rows(t, *numbers, bounds, clock.after, clock.before)
    usable = ~np.isin(codes, (Code.NON_FINITE, Code.TIME_JUMP))
    gap = bounds.max_gap_s
    offset, span, leap = clock.fix_offset(t, usable, gap), None, None
    if t is not None:
        codes[clock.find_stray_times(t, usable, offset, gap) & (codes != Code.LIMIT)] = Code.TIME_JUMP
        span = time_span(t, codes)
        leap = clock.find_leap(t, usable & (codes != Code.TIME_JUMP), offset, gap)
    if t is not None and leap is not None:
        codes[(np.arange(len(t)) >= leap[0]) & (codes != Code.NON_FINITE)] = Code.TIME_JUMP
        span = time_span(t[: leap[0]], codes[: leap[0]])
        if span is None and clock.after is not None:
            span = clock.after, clock.after  # the next batch, too, must lie after the time before the jump
    ddq = np.full_like(measured.q, np.nan) if measured.ddq is None else measured.ddq
    time = clock.event_time(t, offset, len(measured))
    if forgetting_s is not None:
        codes[(codes == Code.LEARNT) & (time < clock.arrived - MAX_AGE_TIME_CONSTANTS * forgetting_s)] = Code.LATE
    if t is None or len(measured) == 1:
        weights = independence.stream_weights(time, previous)
    else:
        weights = independence.even_weights(t)
    rows = Rows(time, measured.q, measured.dq, ddq, measured.tau, codes, weights)
    return DatedRows(rows, offset, span, None if leap is None else leap[1])
