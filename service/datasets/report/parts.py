"""Contiguous parts of a recording, and few rows that stand for many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array

Rows = NDArray[np.int64]


def number_parts(rows: int, breaks: list[NDArray[np.bool_]]) -> Rows:
    """Number of the part that each row belongs to, from 0, (rows,).

    breaks: (rows - 1,) each, true where a row does not follow the one before.
    """
    part = np.zeros(rows, np.int64)
    if rows > 1 and breaks:
        np.cumsum(np.logical_or.reduce(breaks), out=part[1:])
    return part


def bounds(part: Rows) -> tuple[Rows, Rows]:
    """First rows of the parts, and the rows after their last ones, (P,) each."""
    if len(part) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    changes = np.flatnonzero(np.diff(part)) + 1
    return np.concatenate([[0], changes]), np.concatenate([changes, [len(part)]])


def thin(part: Rows, most: int, margin: int = 0) -> Rows:
    """At most `most` rows, evenly spread over all that are `margin` rows and more from either end of their part."""
    starts, ends = bounds(part)
    starts, inner = starts + margin, np.maximum(0, ends - starts - 2 * margin)
    before = np.concatenate([[0], np.cumsum(inner)])
    total = int(before[-1])
    if total == 0:
        return np.zeros(0, np.int64)
    chosen = np.arange(total) if total <= most else np.linspace(0, total - 1, most).astype(np.int64)
    home = np.searchsorted(before, chosen, side="right") - 1
    return np.asarray(starts[home] + chosen - before[home], np.int64)


def finite(value: float | np.floating) -> float | None:
    """A number for JSON: None where it is infinite or none."""
    return float(value) if np.isfinite(value) else None


def spread(values: Array) -> float:
    """Standard deviation, 0 where there are no values."""
    return float(values.std()) if len(values) else 0.0
