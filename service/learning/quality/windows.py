"""Sums over sliding windows of time, of bounded size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import reduce
from operator import add

from lipcore.online.record import Record

PARTS = 60
"""Buckets of a window: its length is true to a sixtieth."""


class Window:
    """Records and counts of the last `seconds`, in at most PARTS + 1 buckets. Read it from any thread."""

    def __init__(self, seconds: float, n_joints: int) -> None:
        self.seconds, self._n_joints = seconds, n_joints
        self._length = max(seconds / PARTS, 1.0)
        self._buckets: tuple[tuple[int, Record, Counter[str]], ...] = ()

    def add(self, record: Record | None, counts: Mapping[str, int], at: float) -> None:
        """Add what came at a Unix time, s. From one thread at a time."""
        number = int(at // self._length)
        *rest, last = self._buckets or ((number, Record.empty(self._n_joints), Counter[str]()),)
        if last[0] != number:
            rest, last = [*rest, last], (number, Record.empty(self._n_joints), Counter[str]())
        changed = number, last[1] if record is None else last[1] + record, last[2] + Counter(counts)
        # replaced as a whole: readers keep what they have
        self._buckets = tuple(bucket for bucket in (*rest, changed) if self._holds(bucket[0], at))

    def record(self, now: float) -> Record:
        """Sum of the records that came within the window before a Unix time, s."""
        records = (bucket[1] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, records, Record.empty(self._n_joints))

    def counts(self, now: float) -> Counter[str]:
        """Sum of the counts that came within the window before a Unix time, s."""
        counts = (bucket[2] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, counts, Counter[str]())

    def _holds(self, number: int, now: float) -> bool:
        return (number + 1) * self._length > now - self.seconds
