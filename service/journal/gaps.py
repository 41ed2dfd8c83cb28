"""Which sequence numbers of a stream have not come: ranges between the lowest and the highest that have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

MOST_RANGES = 1000
"""Ranges that are remembered; the lowest are given up first, as what they wait for is the least likely to come."""


@dataclass(frozen=True)
class Gaps:
    """first, last: lowest and highest sequence that came; ranges: [a, b] in between that did not, rising."""

    first: int
    last: int
    ranges: tuple[tuple[int, int], ...] = ()

    def arrived(self, first: int, last: int) -> Gaps:
        """The gaps once `first` to `last` have come too, in whatever order things come."""
        left: list[tuple[int, int]] = []
        if last + 1 < self.first:
            left.append((last + 1, self.first - 1))
        for a, b in self.ranges:
            if a < first:
                left.append((a, min(b, first - 1)))
            if b > last:
                left.append((max(a, last + 1), b))
        if self.last + 1 < first:
            left.append((self.last + 1, first - 1))
        return Gaps(min(self.first, first), max(self.last, last), tuple(left[-MOST_RANGES:]))

    def came(self, sequence: int) -> bool:
        """Whether a sequence may have come: not where it is known to be missing."""
        return self.first <= sequence <= self.last and not any(a <= sequence <= b for a, b in self.ranges)

    def to_json(self) -> dict[str, Any]:
        """As a stream's row keeps them, which has `last` in a column of its own."""
        return {"first": self.first, "ranges": [list(pair) for pair in self.ranges]}

    @staticmethod
    def from_json(missing: dict[str, Any], last: int) -> Gaps:
        """Read what `to_json` wrote."""
        return Gaps(missing["first"], last, tuple((a, b) for a, b in missing["ranges"]))
