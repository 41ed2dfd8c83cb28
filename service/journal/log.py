"""The event log of a model, in the order of commits. The learnt state is a function of it.

Functions that write are called inside `Database.transaction()`: numbers are given out under its lock, so that they are
dense and rise in the order of commits, and an event is durable once the transaction has ended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save
from sqlalchemy import Select, bindparam, func, select
from sqlalchemy.orm import Session, undefer

from lipcore.data.samples import Array
from lipcore.online.batch import AHEAD_S, Placement, Rows
from lipcore.vocabulary import Code
from service.journal.arrivals import NewBatch, note_arrival
from service.storage.database import EventRow, LearnerRow, LearningRow, StreamRow, fetch
from service.storage.rows import Page
from service.storage.rows import newest as newest_rows

EventKind = Literal["batch", "replay", "unlearn", "rollback", "change", "settings", "payload"]
UNTIMED = [Code.NON_FINITE, Code.TIME_JUMP]
"""Codes of rows whose own time says nothing."""
ARRAYS = tuple(field.name for field in fields(Rows))
"""Of the safetensors archive that an event's rows are kept as."""


_OF_STREAM = select(EventRow).where(EventRow.model == bindparam("model"), EventRow.stream_id == bindparam("stream_id"))
_BEFORE = _OF_STREAM.where(EventRow.sequence < bindparam("sequence")).order_by(EventRow.sequence.desc()).limit(1)
_AFTER = _OF_STREAM.where(EventRow.sequence > bindparam("sequence")).order_by(EventRow.sequence).limit(1)
_NEWEST = select(EventRow.number).where(EventRow.model == bindparam("model")).order_by(EventRow.number.desc()).limit(1)
_OF_MODEL = EventRow.model == bindparam("model")
_LATEST = select(EventRow.received, EventRow.clock).where(_OF_MODEL).order_by(EventRow.number.desc()).limit(1)
_OPTIONS = select(LearningRow.options).where(LearningRow.model == bindparam("model"))
_START = select(LearnerRow.start).where(
    LearnerRow.model == bindparam("model"), LearnerRow.version == bindparam("version")
)


@dataclass(frozen=True)
class Memory:
    """What events of the kind `settings` set. forgetting_s: time constant of forgetting, s, None where nothing is
    forgotten; friction_walk_s: that of friction that drifts, s, None where it does not."""

    forgetting_s: float | None = None
    friction_walk_s: float | None = None

    def to_json(self) -> dict[str, Any]:
        """As an event keeps it."""
        walk = {} if self.friction_walk_s is None else {"friction_walk_s": self.friction_walk_s}
        return {"forgetting_s": self.forgetting_s} | walk

    @staticmethod
    def from_json(detail: dict[str, Any]) -> Memory:
        """Read what `to_json` wrote."""
        return Memory(detail["forgetting_s"], detail.get("friction_walk_s"))


def append_batch(
    session: Session, model: str, batch: NewBatch, most_streams: int | None = None
) -> tuple[EventRow, StreamRow]:
    """Log a batch and what its stream still misses; return its event, which is written with the session's next flush,
    and the row of its stream.

    Raise ConflictError where the stream is of another kind, where frames do not go on after the last, or where the
    batch may have been learnt before and is no longer kept; BusyError beyond `most_streams` streams in use. That
    no batch of this sequence is kept is checked with `find_batch` before, in the same transaction.
    """
    names = ("stream_id", "sequence", "last_sequence", "digest", "version", "revision", "report", "record")
    event = EventRow(number=newest(session, model) + 1, **{name: getattr(batch, name) for name in names})
    source = note_arrival(session, model, batch, most_streams)
    return _append(session, event, model, "batch", batch.received, batch.rows), source


def append(
    session: Session, model: str, kind: EventKind, detail: dict[str, Any], received: float, rows: Rows | None = None
) -> EventRow:
    """Log an event of another kind than a batch; return it."""
    event = _append(session, EventRow(number=newest(session, model) + 1, detail=detail), model, kind, received, rows)
    session.flush()
    return event


def find_batch(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """The batch of exactly this sequence."""
    return session.scalar(_of_stream(model, stream_id).where(EventRow.sequence == sequence))


def covering(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """The batch that this sequence lies in, of frames or of its own."""
    query = _of_stream(model, stream_id).where(EventRow.sequence <= sequence).order_by(EventRow.sequence.desc())
    event = session.scalar(query.limit(1))
    return event if event is not None and event.last_sequence is not None and sequence <= event.last_sequence else None


@dataclass(frozen=True)
class Past:
    """What is kept of a stream around a sequence. source: its row, None of a new stream; same: the batch of exactly
    this sequence; below, above: those next to it, with a gap in between or without."""

    source: StreamRow | None
    same: EventRow | None = None
    below: EventRow | None = None
    above: EventRow | None = None


def past(session: Session, model: str, stream_id: str, sequence: int) -> Past:
    """Read what is kept of a stream around a sequence."""
    source = stream(session, model, stream_id)
    if source is None:
        return Past(None)
    place = {"model": model, "stream_id": stream_id, "sequence": sequence}
    below = session.scalar(_BEFORE, place)
    if sequence > source.last:  # most batches are the last of their stream
        return Past(source, None, below)
    return Past(source, find_batch(session, model, stream_id, sequence), below, session.scalar(_AFTER, place))


def derived_beside(session: Session, model: str, stream_id: str, sequence: int) -> int | None:
    """The window of the batches right next to a sequence, see `Placement`; None if none of them was derived."""
    for other in (sequence - 1, sequence + 1):
        if (event := _derived(session, model, stream_id, other)) is not None:
            return Placement.from_json(event.report or {}).window
    return None


def rows_beside(session: Session, model: str, stream_id: str, sequence: int, way: int, count: int) -> list[Rows]:
    """Rows whose accelerations were derived, next after (way 1) or before (−1) a sequence, without a gap of sequences,
    in order, at most `count`."""
    parts: list[Rows] = []
    while count > 0:
        sequence += way
        event = _derived(session, model, stream_id, sequence)
        if event is None:
            break
        own = Placement.from_json(event.report or {}).own
        part = rows_of(event).take(slice(*own))  # without those that had waited for it
        parts.append(part.take(slice(0, count) if way > 0 else slice(max(len(part) - count, 0), None)))
        count -= len(part)
    return parts[::way]


def _derived(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """The batch of a sequence, if its accelerations were derived and it still teaches."""
    event = find_batch(session, model, stream_id, sequence)
    if event is None or event.void or event.report is None:
        return None
    return event if Placement.from_json(event.report).window is not None else None


def stream(session: Session, model: str, stream_id: str) -> StreamRow | None:
    """What is known of a source of observations."""
    return session.get(StreamRow, (model, stream_id))


def newest(session: Session, model: str) -> int:
    """Number of the newest event, 0 where there is none."""
    return fetch(session, _NEWEST, model=model).scalar() or 0


def events(session: Session, model: str, after: int, limit: int, void: bool = False) -> list[EventRow]:
    """Events above number `after` with their payload, rising, at most `limit`; void ones only where asked for."""
    query = select(EventRow).where(EventRow.model == model, EventRow.number > after).order_by(EventRow.number)
    if not void:
        query = query.where(EventRow.void.is_(False))
    return list(session.scalars(query.limit(limit).options(undefer(EventRow.payload))))


def is_complete(session: Session, model: str, after: int, through: int) -> bool:
    """Whether every event with after < number <= through is kept: without it there is no state that needs them."""
    span = (EventRow.model == model, EventRow.number > after, EventRow.number <= through)
    return session.scalar(select(func.count()).select_from(EventRow).where(*span)) == max(through - after, 0)


def page(
    session: Session, model: str, part: Page, stream_id: str | None = None, rejected: bool = False
) -> tuple[list[EventRow], str | None]:
    """Batches of a page, newest first, and the cursor after it; rejected: only those with rows that are not learnt."""
    conditions = [EventRow.model == model, EventRow.kind == "batch"]
    if stream_id is not None:
        conditions.append(EventRow.stream_id == stream_id)
    if rejected:
        conditions.append(EventRow.learnt < EventRow.rows)
    return newest_rows(session, EventRow, part, *conditions)


def about(session: Session, batch: EventRow, kind: Literal["replay", "unlearn"]) -> Sequence[EventRow]:
    """Events that have learnt rows of a batch later, or have taken it out, in order, also those undone since."""
    query = select(EventRow).where(
        EventRow.model == batch.model,
        EventRow.number > batch.number,
        EventRow.kind == kind,
        EventRow.detail["event"].as_integer() == batch.number,
    )
    return session.scalars(query.order_by(EventRow.number)).all()


def rows_of(event: EventRow) -> Rows:
    """The rows of a batch or a replay, which are read only now."""
    assert event.payload is not None  # both have one for as long as they are in the log
    return decode(event.payload)


def memory(session: Session, model: str, number: int) -> Memory:
    """What is set after event `number`."""
    query = select(EventRow.detail).where(
        EventRow.model == model, EventRow.number <= number, EventRow.kind == "settings", EventRow.void.is_(False)
    )
    detail = session.scalar(query.order_by(EventRow.number.desc()).limit(1))
    return Memory() if detail is None else Memory.from_json(detail)


def start_of(session: Session, model: str, version: int) -> int:
    """Number of the last event that a version contains by training."""
    return fetch(session, _START, model=model, version=version).scalar() or 0


def clock(session: Session, model: str, received: float) -> float:
    """Time of a model's own clock at an arrival, Unix time, s. It goes on with arrivals, never back, and in a pause by
    no more than the shortest time constant that is set: no clock that is wrong, or set right, makes it forget more."""
    latest = session.execute(_LATEST, {"model": model}).first()
    if latest is None:
        return received
    options = fetch(session, _OPTIONS, model=model).scalar() or {}
    constants = [options.get(name) for name in ("forgetting_s", "friction_walk_s")]
    longest = min((each for each in constants if each is not None), default=math.inf)
    before, last = latest
    return (before if last is None else last) + min(max(received - before, 0.0), longest)


def learning_time(event: EventRow, time: Array | float) -> Array:
    """Event times of an event, s, by the model's own clock: as late as they were when it arrived, and never later than
    its arrival by more than AHEAD_S."""
    if event.clock is None:  # logged by an earlier release
        return np.asarray(time)
    return np.asarray(event.clock + np.minimum(time - event.received, AHEAD_S))


def learning_rows(event: EventRow) -> Rows:
    """The rows of a batch or a replay, which are read only now, at times of the model's own clock."""
    rows = rows_of(event)
    # those of a replay have times of that clock already: they are as old as their batch
    return rows if event.kind == "replay" else replace(rows, time=learning_time(event, rows.time))


def pending(session: Session, model: str, after: int) -> tuple[int, float | None]:
    """Rows to be learnt after event `after`, and when the first of them arrived, Unix time, s; None without any."""
    later = EventRow.model == model, EventRow.number > after, EventRow.learnt > 0, EventRow.void.is_(False)
    rows, arrived = session.execute(select(func.sum(EventRow.learnt), func.min(EventRow.received)).where(*later)).one()
    return int(rows or 0), arrived


def encode(rows: Rows) -> bytes:
    """Write rows, bit for bit."""
    return save({name: np.ascontiguousarray(getattr(rows, name)) for name in ARRAYS})


def decode(data: bytes) -> Rows:
    """Read what `encode` wrote; raise ValueError where it is damaged."""
    try:
        arrays = load(data)
    except SafetensorError as error:
        raise ValueError(f"logged rows cannot be read: {error}") from None
    if sorted(arrays) != sorted(ARRAYS):
        raise ValueError(f"logged rows have the arrays {', '.join(sorted(arrays))}, expected {', '.join(ARRAYS)}")
    return Rows(**arrays)


def _of_stream(model: str, stream_id: str) -> Select[EventRow]:
    return select(EventRow).where(EventRow.model == model, EventRow.stream_id == stream_id)


def _append(
    session: Session, event: EventRow, model: str, kind: EventKind, received: float, rows: Rows | None
) -> EventRow:
    event.model, event.kind, event.received = model, kind, received
    event.clock = clock(session, model, received)
    if rows is not None:
        event.payload, event.rows, event.learnt = encode(rows), len(rows), int(np.sum(rows.code == Code.LEARNT))
        times = rows.time[np.isfinite(rows.time) & ~np.isin(rows.code, UNTIMED)]
        if len(times):
            event.first, event.last = float(times.min()), float(times.max())
    session.add(event)
    return event
