"""Sum prequential records over the last minutes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import reduce
from operator import add

from lipcore.online.record import Record
from lipcore.online.scale import IntervalCoverage

PARTS = 60
"""Buckets of a window: its length is exact to a sixtieth."""


class Window:
    """Records and counts of the last `seconds`, in at most PARTS + 1 buckets. Any thread may read it."""

    def __init__(self, seconds: float, n_joints: int) -> None:
        self.seconds, self._n_joints = seconds, n_joints
        self.span_s = max(seconds / PARTS, 1.0)
        """Length of a bucket, s."""
        self._buckets: tuple[tuple[int, Record, Counter[str], IntervalCoverage], ...] = ()

    def add(
        self, record: Record | None, counts: Mapping[str, int], at: float, held: IntervalCoverage | None = None
    ) -> None:
        """Add a batch's record, counts and coverage (`held`) at a Unix time, s. Only one thread at a time may add."""
        number = int(at // self.span_s)
        empty = number, Record.empty(self._n_joints), Counter[str](), IntervalCoverage.none(self._n_joints)
        *rest, last = self._buckets or (empty,)
        if last[0] != number:
            rest, last = [*rest, last], empty
        changed = (
            number,
            last[1] if record is None else last[1] + record,
            last[2] + Counter(counts),
            last[3] if held is None else last[3] + held,
        )
        # a new tuple each time, because other threads may be reading the old one
        self._buckets = tuple(bucket for bucket in (*rest, changed) if self._holds(bucket[0], at))

    def record(self, now: float) -> Record:
        """Return the sum of the records in the window before a Unix time, s."""
        records = (bucket[1] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, records, Record.empty(self._n_joints))

    def course(self, now: float) -> list[tuple[float, Record]]:
        """Return the records of the window's buckets, oldest first, each with the Unix time at which it began, s."""
        return [(number * self.span_s, record) for number, record, *_ in self._buckets if self._holds(number, now)]

    def count_spans(self, now: float) -> int:
        """Return the number of buckets with predicted rows in the window before a Unix time, s."""
        return sum(record.rows > 0 for _, record in self.course(now))

    def counts(self, now: float) -> Counter[str]:
        """Return the sum of the counts in the window before a Unix time, s."""
        counts = (bucket[2] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, counts, Counter[str]())

    def held(self, now: float) -> IntervalCoverage:
        """Return the coverage of the returned intervals in the window before a Unix time, s."""
        parts = (bucket[3] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, parts, IntervalCoverage.none(self._n_joints))

    def set_clock(self, step: float) -> None:
        """Shift the buckets after the clock was set by `step`, s."""
        moved = round(step / self.span_s)
        self._buckets = tuple((bucket[0] + moved, *bucket[1:]) for bucket in self._buckets)

    def _holds(self, number: int, now: float) -> bool:
        """Whether a bucket lies in the window before a Unix time, s; one that a wrong clock dated later does not."""
        return -self.seconds < (number + 1) * self.span_s - now <= 2 * self.span_s
