"""When the rows of a batch were measured. They are dated in event time: Unix time, counted by the stream's own clock.

A stream's offset is fixed once, so that the last row of its first batch lies at that batch's arrival. It is 0 where no
batch of the stream has had times yet.
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

FAR_AHEAD = 86400.0
"""How far ahead of its arrival a row may be dated, s: as long a recording may be sent in one go."""


LEAP_S = 60.0
"""A clock that leaps further ahead of its rows' arrival, s, is wrong: so much time has not passed. A recording that is
sent faster than it was measured comes to lie as far ahead step by step."""
FORGOTTEN = 7.0
"""Time constants of forgetting after which a row counts a thousandth, and teaches nothing."""


@dataclass(frozen=True)
class Measured:
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
    """What is known of a stream's time when a batch arrives.

    offset: s, None while it is unknown. after, before: times, by the stream's clock, that the rows must lie between.
    adjacent: whether `after` is the time of the row right before the batch. arrived: Unix time, s.
    """

    offset: float | None
    after: float | None
    before: float | None
    adjacent: bool
    arrived: float

    @staticmethod
    def of(
        offset: float, before: Placement | None, after: Placement | None, adjacent: bool, arrived: float
    ) -> StreamTime:
        """Return the clock of a stream. offset: s, 0 while it is unknown; before, after: the batches that are kept next
        below and above the sequence; adjacent: whether the one below is the previous sequence."""
        latest = arrived + FAR_AHEAD - offset if offset else None
        last = None if before is None or before.span is None else before.span[1]
        first = None if after is None or after.span is None else after.span[0]
        bounds = [bound for bound in (latest, first) if bound is not None]
        return StreamTime(offset or None, last, min(bounds, default=None), adjacent, arrived)

    def settled(self, t: Array | None, usable: NDArray[np.bool_], gap: float) -> float:
        """The offset, s, fixed now if these rows (times (N,), those to be believed) are the first that have times."""
        if self.offset is not None:
            return self.offset
        if t is None or not usable.any():
            return 0.0
        times = t[usable]
        runs = np.split(times, np.flatnonzero(np.diff(times) > gap) + 1)
        # one wrong time at the end, far from all others, must not date them all
        last = next((run for run in reversed(runs) if len(run) > 1), runs[-1])
        return self.arrived - float(last[-1])

    def leaps(self, t: Array, usable: NDArray[np.bool_], offset: float, gap: float) -> NDArray[np.bool_]:
        """Rows (N,) dated later than now, right after a gap, and before another one or at the end: most likely wrong.
        Taken for true, such a time would be the present for all rows to come."""
        leaping = np.zeros(len(t), dtype=np.bool_)
        times = t[usable]
        start = self.after if self.adjacent and self.after is not None else times[:1]
        after_gap = np.diff(times, prepend=start) > gap
        alone = after_gap & np.append(after_gap[1:], True)
        leaping[usable] = alone[: len(times)] & (times + offset > self.arrived + gap)
        return leaping

    def leap(self, t: Array, usable: NDArray[np.bool_], offset: float, gap: float) -> tuple[int, float] | None:
        """The row from which on a clock has leapt ahead of the rows' arrival, and how far, s; None where it has not."""
        places = np.flatnonzero(usable)
        ahead = t[places] + offset - self.arrived
        first = ahead[:1] if self.after is None else self.after + offset - self.arrived
        before = np.append(first, ahead[:-1])[: len(ahead)]
        leapt = np.flatnonzero((ahead > LEAP_S) & (before <= LEAP_S) & (ahead - before > gap))
        return (int(places[leapt[0]]), float(ahead[leapt[0]])) if len(leapt) else None

    def event_time(self, t: Array | None, offset: float, rows: int) -> Array:
        """Event times (N,), s, finite: a row without a time has that of the row before it."""
        if t is None:
            return np.full(rows, self.arrived)
        known = np.isfinite(t)
        place = np.maximum.accumulate(np.where(known, np.arange(rows), 0))
        times = t[place] + offset
        return np.where(np.isfinite(times), times, self.arrived)


@dataclass(frozen=True)
class Dated:
    """Rows with event times and the codes of `check_rows`. offset: of the stream, s; span: first and last time of the
    batch, by its stream's clock, that its neighbours lie before and after; leap: how far its clock has leapt ahead of
    the rows' arrival, s, None where it has not."""

    rows: Rows
    offset: float
    span: tuple[float, float] | None
    leap: float | None


def date_rows(
    measured: Measured, clock: StreamTime, bounds: RowLimits, previous: float | None, forgetting_s: float | None = None
) -> Dated:
    """Check, date and weigh rows. previous: event time of the row right before them, s, where it is known;
    forgetting_s: how the model forgets. Weights come from the batch itself where it has a spacing, so that they do not
    depend on the order of arrival."""
    t = measured.t
    numbers = measured.q, measured.dq, measured.ddq, measured.tau
    codes = check_rows(t, *numbers, bounds, clock.after, clock.before)
    usable = ~np.isin(codes, (Code.NON_FINITE, Code.TIME_JUMP))
    gap = bounds.max_gap_s
    offset, span, leap = clock.settled(t, usable, gap), None, None
    if t is not None:
        codes[clock.leaps(t, usable, offset, gap) & (codes != Code.LIMIT)] = Code.TIME_JUMP
        span = time_span(t, codes)
        leap = clock.leap(t, usable & (codes != Code.TIME_JUMP), offset, gap)
    if t is not None and leap is not None:
        codes[(np.arange(len(t)) >= leap[0]) & (codes != Code.NON_FINITE)] = Code.TIME_JUMP
        span = time_span(t[: leap[0]], codes[: leap[0]])
        if span is None and clock.after is not None:
            span = clock.after, clock.after  # the next batch is compared with what came before the leap, too
    ddq = np.full_like(measured.q, np.nan) if measured.ddq is None else measured.ddq
    time = clock.event_time(t, offset, len(measured))
    if forgetting_s is not None:
        codes[(codes == Code.LEARNT) & (time < clock.arrived - FORGOTTEN * forgetting_s)] = Code.LATE
    if t is None or len(measured) == 1:
        weights = independence.stream_weights(time, previous)
    else:
        weights = independence.even_weights(t)
    rows = Rows(time, measured.q, measured.dq, ddq, measured.tau, codes, weights)
    return Dated(rows, offset, span, None if leap is None else leap[1])
