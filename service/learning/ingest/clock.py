"""From a stream's own time to event time: Unix time, counted by the stream's clock.

A stream's offset is fixed once, so that the last row of its first batch lies at that batch's arrival. It is 0 where no
batch of the stream has had times yet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.gates import time_span
from service.storage.database import EventRow, StreamRow

FAR_AHEAD = 86400.0
"""How far ahead of its arrival a row may be dated, s: as long a recording may be sent in one go."""


@dataclass(frozen=True)
class Clock:
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
        source: StreamRow | None, sequence: int, before: EventRow | None, after: EventRow | None, arrived: float
    ) -> Clock:
        """The clock of a stream, with the batches that are kept next below and above a sequence."""
        offset = None if source is None or source.offset == 0 else source.offset
        first, last = _span(after), _span(before)
        latest = None if offset is None else arrived + FAR_AHEAD - offset
        bounds = [bound for bound in (latest, None if first is None else first[0]) if bound is not None]
        adjacent = before is not None and before.last_sequence == sequence - 1
        return Clock(offset, None if last is None else last[1], min(bounds, default=None), adjacent, arrived)

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
        """Rows (N,) dated later than now that come right after a gap, and before another or last: wrong, most likely.

        Taken for true, such a time would be the present for all rows to come.
        """
        found = np.zeros(len(t), dtype=np.bool_)
        times = t[usable]
        start = self.after if self.adjacent and self.after is not None else times[:1]
        after_gap = np.diff(times, prepend=start) > gap
        alone = after_gap & np.append(after_gap[1:], True)
        found[usable] = alone[: len(times)] & (times + offset > self.arrived + gap)
        return found

    def event_time(self, t: Array | None, offset: float, rows: int) -> Array:
        """Event times (N,), s, finite: a row without a time has that of the row before it."""
        if t is None:
            return np.full(rows, self.arrived)
        known = np.isfinite(t)
        place = np.maximum.accumulate(np.where(known, np.arange(rows), 0))
        times = t[place] + offset
        return np.where(np.isfinite(times), times, self.arrived)


def span(t: Array | None, codes: NDArray[np.uint8]) -> list[float] | None:
    """First and last time of a batch, by its stream's clock, that its neighbours lie before and after."""
    found = None if t is None else time_span(t, codes)
    return None if found is None else list(found)


def _span(event: EventRow | None) -> list[float] | None:
    found: list[float] | None = None if event is None or event.report is None else event.report["span"]
    return found
