"""When samples were taken: rate, jitter, gaps; and which raw rows follow each other without any of these."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from service.datasets.report.parts import Rows, finite, number_parts
from service.datasets.report.schema import Gap, Timing
from service.datasets.staging import EPISODE, TIME, Staged

MOST_GAPS = 20
"""Gaps that a report lists."""


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
