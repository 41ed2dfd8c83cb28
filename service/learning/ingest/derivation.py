"""Accelerations that were not sent: derived within the stream, across the batches next to each other.

An acceleration stands on the velocities of `half` rows on either side of its row. At the ends of a batch they are those
of the batches before and after. A row waits, coded `edge`, until both are there, in whatever order; it is decided with
the later one, so that it is learnt exactly once, and as if the stream were one batch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online import acceleration
from lipcore.online.acceleration import JITTER, RateError, derive
from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES
from service.foundation.errors import invalid_request
from service.journal import log
from service.storage.database import EventRow

EDGE = CODES.index("edge")


@dataclass(frozen=True)
class Derived:
    """Rows before, of and after a batch. ddq: NaN where it is not known; own: which of the rows are the batch's own.

    decided: rows of other batches that this one completes. window: rows on either side; rate: Hz; delay_s: s.
    """

    rows: Rows
    own: slice
    decided: NDArray[np.bool_]
    window: int
    rate: float
    delay_s: float


def complete(session: Session, model: str, stream_id: str, sequence: int, rows: Rows, t: Array) -> Derived:
    """Derive the accelerations of a batch of rows, whose `ddq` is not looked at. t: (N,) by the stream's own clock, s.

    Raise InvalidRequestError where the rows are too slow or too uneven for it.
    """
    rate = _rate(t)
    key = session, model, stream_id, sequence
    half = _window(*key) or acceleration.window(rate)
    head, tail = (_around(*key, way, 2 * half) for way in (-1, 1))
    everything = Rows.concatenate([*head, rows, *tail])
    first = sum(map(len, head))
    own = slice(first, first + len(rows))
    ddq = _slopes(everything, half, rate)
    known = np.isfinite(ddq).all(axis=1)
    place = np.arange(len(everything))
    other = (place < own.start) | (place >= own.stop)
    # 2 half rows on either side are so few that every window that is complete reaches into the batch: none was before
    decided = known & other & (everything.code == EDGE)
    return Derived(replace(everything, ddq=ddq), own, decided, half, rate, half / rate)


def _rate(t: Array) -> float:
    """Rows a second, in the longest stretch without a gap: event time is too coarse to tell, to 0.2 µs today.

    Raise InvalidRequestError where accelerations cannot be derived at this rate, or time is too uneven.
    """
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        raise invalid_request("t", f"{len(finite)} times", "at least 2 rows with times, to derive ddq from dq with")
    steps = np.diff(finite)
    rising = steps[steps > 0]
    step = float(np.median(rising)) if len(rising) else 0.0
    run = max(_runs(t, np.isfinite(t), step), key=len)
    if len(run) < 2 or 2 * np.count_nonzero(_even(steps, step)) < len(steps):
        spread = f"uneven, with steps from {steps.min():.3g} to {steps.max():.3g} s"
        raise invalid_request("t", spread, f"steps that differ by at most {JITTER:.0%}, to derive ddq from dq with")
    rate = (len(run) - 1) / float(t[run[-1]] - t[run[0]])
    try:
        acceleration.window(rate * (1 - 1e-9))  # so that rounding leads to no other answer later
    except RateError:
        expected = f"measured accelerations, or at least {acceleration.MIN_RATE:g} rows a second to derive them from"
        raise invalid_request("ddq", f"missing, with {rate:.3g} rows a second", expected) from None
    return rate


def _runs(t: Array, usable: NDArray[np.bool_], step: float) -> list[NDArray[np.int64]]:
    """Places of rows that follow each other evenly, run after run."""
    joined = usable[:-1] & usable[1:]
    joined[joined] = _even(t[1:][joined] - t[:-1][joined], step)
    return np.split(np.arange(len(t)), np.flatnonzero(~joined) + 1)


def _even(steps: Array, step: float) -> NDArray[np.bool_]:
    return np.asarray((steps > 0) & (np.abs(steps - step) <= JITTER * step))


def _slopes(rows: Rows, half: int, rate: float) -> Array:
    """Accelerations of all rows in the middle of 2·half + 1 even ones, NaN for the others: (N, n)."""
    ddq = np.full_like(rows.dq, np.nan)
    usable = np.isfinite(rows.time) & np.isfinite(rows.dq).all(axis=1)
    for run in _runs(rows.time, usable, 1 / rate):
        if len(run) > 2 * half:
            # a controller samples more evenly than it stamps, and event time is coarse
            slopes = derive(np.arange(len(run)) / rate, rows.dq[run], half)
            ddq[run[slopes.first : slopes.first + len(slopes.ddq)]] = slopes.ddq
    return ddq


def _window(session: Session, model: str, stream_id: str, sequence: int) -> int | None:
    """Window of the batches next to this one: a stream has one, however its rate is measured."""
    for other in (sequence - 1, sequence + 1):
        event = _neighbour(session, model, stream_id, other)
        if event is not None and event.report is not None:
            return int(event.report["derived"]["ddq"]["window"])
    return None


def _neighbour(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """The batch of a sequence, if its accelerations were derived and it still teaches."""
    event = log.find_batch(session, model, stream_id, sequence)
    if event is None or event.void or event.report is None or event.report["derived"] is None:
        return None
    return event


def _around(session: Session, model: str, stream_id: str, sequence: int, way: int, count: int) -> list[Rows]:
    """Rows next after (way 1) or before (−1) a batch, without a gap of sequences, in order, at most `count`."""
    parts: list[Rows] = []
    while count > 0:
        sequence += way
        event = _neighbour(session, model, stream_id, sequence)
        if event is None:
            break
        part = _own(event)
        parts.append(part.take(slice(0, count) if way > 0 else slice(max(len(part) - count, 0), None)))
        count -= len(part)
    return parts[::way]


def _own(event: EventRow) -> Rows:
    """A batch's own rows, without those that had waited for it."""
    first, last = (event.report or {})["own"]
    return log.rows_of(event).take(slice(first, last))
