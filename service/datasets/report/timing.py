"""When samples were taken: rate, jitter, gaps; contiguous parts between these, and few rows that stand for many."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.schema import Gap, Timing
from service.datasets.staging import EPISODE, TIME, Staged

Rows = NDArray[np.int64]
MOST_GAPS = 20
"""Gaps that a report lists."""


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


@dataclass(frozen=True)
class Clock:
    """Times of a raw recording.

    part: number of the contiguous part that each row belongs to, (N,); missing: rows that lack a value, (N,).
    """

    timing: Timing
    part: Rows
    missing: NDArray[np.bool_]


def look_at_clock(raw: Staged, gap_steps: float, repeated: int) -> Clock:
    """Judge the times of a raw recording.

    gap_steps: a step of time longer than so many usual ones is a gap; repeated: stamps left out while it was read.
    """
    missing = raw.missing()
    breaks = [missing[1:] | missing[:-1]]
    if EPISODE in raw:
        breaks.append(np.diff(raw.read(EPISODE)) != 0)
    if TIME not in raw:
        return Clock(_without_times(int(missing.sum())), number_parts(raw.rows, breaks), missing)
    t = raw.read(TIME)
    steps = np.diff(t)
    inside = ~np.logical_or.reduce(breaks) & np.isfinite(steps)
    inside &= steps > 0  # rows that repeat a stamp are counted by whoever leaves them out
    usual = float(np.median(steps[inside])) if inside.any() else 0.0
    if usual <= 0:
        return Clock(_without_times(int(missing.sum())), number_parts(raw.rows, breaks), missing)
    gap = inside & (steps > gap_steps * usual)
    even = inside & ~gap
    deviation = np.abs(steps[even] / usual - 1)
    middle, far = np.quantile(deviation, [0.5, 0.99]) if len(deviation) else (np.nan, np.nan)
    timing = Timing(
        rate_hz=1 / usual,
        duration_s=float(steps[even].sum()),
        jitter_p50=finite(middle),
        jitter_p99=finite(far),
        jitter_max=float(deviation.max()) if len(deviation) else None,
        gaps=_longest(t, steps, np.flatnonzero(gap)),
        repeated_stamps=repeated,
        missing_rows=int(missing.sum()),
    )
    return Clock(timing, number_parts(raw.rows, [*breaks, gap]), missing)


def _longest(t: Array, steps: Array, gaps: NDArray[np.intp]) -> list[Gap]:
    longest = np.sort(gaps[np.argsort(-steps[gaps], kind="stable")[:MOST_GAPS]])
    return [Gap(t=float(t[row]), seconds=float(steps[row])) for row in longest]


def _without_times(missing: int) -> Timing:
    return Timing(
        rate_hz=None,
        duration_s=None,
        jitter_p50=None,
        jitter_p99=None,
        jitter_max=None,
        gaps=[],
        repeated_stamps=0,
        missing_rows=missing,
    )
