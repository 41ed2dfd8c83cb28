"""Accelerations of a batch that was sent without: the slopes of its velocities, and of the batches next to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online import acceleration
from lipcore.online.acceleration import JITTER, RateError
from lipcore.online.batch import Rows
from lipcore.online.gates import RowLimits, check_rows
from lipcore.vocabulary import CODES, LEARNT
from service.contract.observations import DerivedAcceleration
from service.foundation.errors import invalid_request
from service.foundation.text import percent
from service.journal import log
from service.storage.database import EventRow

EDGE = CODES.index("edge")


def derive(
    session: Session, model: str, stream_id: str, sequence: int, rows: Rows, t: Array, bounds: RowLimits
) -> tuple[Rows, slice, DerivedAcceleration]:
    """Derive the accelerations of a batch of rows, across the batches next to it in its stream.

    An acceleration stands on the velocities of `half` rows on either side of its row. At the ends of a batch they are
    those of the batches before and after. A row waits, coded `edge`, until both are there, in whatever order; it is
    decided with the later one, so that it is learnt exactly once, and as if the stream were one batch.

    rows: their `ddq` is not looked at; t: (N,) by the stream's own clock, s. Return the rows with those of other
    batches that they complete, and which are the batch's own. Raise InvalidRequestError where the rows are too slow or
    too uneven for it.
    """
    rate = _rate(t)
    key = session, model, stream_id, sequence
    half = _window(*key) or acceleration.window(rate)
    head, tail = (_around(*key, way, 2 * half) for way in (-1, 1))
    everything = Rows.concatenate([*head, rows, *tail])
    own = np.zeros(len(everything), np.bool_)
    first = sum(map(len, head))
    own[first : first + len(rows)] = True
    everything = replace(everything, ddq=_slopes(everything, half, rate))
    known = np.isfinite(everything.ddq).all(axis=1)
    codes = everything.code.copy()
    # 2 half rows on either side are so few that every window that is complete reaches into the batch: none was before
    decided = known & ~own & (codes == EDGE)
    codes[~known & (codes == LEARNT)] = EDGE
    codes[decided] = LEARNT
    fresh = codes == LEARNT
    again = everything.take(fresh)
    codes[fresh] = check_rows(None, again.q, again.dq, again.ddq, again.tau, bounds)
    before, carried = int(decided[:first].sum()), int(decided.sum())
    summary = DerivedAcceleration(delay_s=half / rate, window=half, rate_hz=rate, carried=carried)
    return replace(everything, code=codes).take(decided | own), slice(before, before + len(rows)), summary


def _rate(t: Array) -> float:
    """Rows a second, in the longest stretch without a gap: event time is too coarse to tell, to 0.2 µs today. Raise
    InvalidRequestError where accelerations cannot be derived at this rate, or time is too uneven."""
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        raise invalid_request("t", f"{len(finite)} times", "at least 2 rows with times, to derive ddq from dq with")
    steps = np.diff(finite)
    rising = steps[steps > 0]
    step = float(np.median(rising)) if len(rising) else 0.0
    run = max(_runs(t, np.isfinite(t), step), key=len)
    if len(run) < 2 or 2 * np.count_nonzero(_even(steps, step)) < len(steps):
        spread = f"uneven, with steps from {steps.min():.3g} to {steps.max():.3g} s"
        raise invalid_request(
            "t", spread, f"steps that differ by at most {percent(JITTER)}, to derive ddq from dq with"
        )
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
            slopes = acceleration.derive(np.arange(len(run)) / rate, rows.dq[run], half)
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
        first, last = (event.report or {})["own"]  # without those that had waited for it
        part = log.rows_of(event).take(slice(first, last))
        parts.append(part.take(slice(0, count) if way > 0 else slice(max(len(part) - count, 0), None)))
        count -= len(part)
    return parts[::way]
