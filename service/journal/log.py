"""The event log of a model, in the order of commits. The learnt state is a function of it.

Functions that write are called inside `Database.transaction()`. Its lock makes event numbers dense and rising in the
order of commits. An event is durable once the transaction has ended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save
from sqlalchemy import Select, bindparam, func, select
from sqlalchemy.orm import Session, undefer

from lipcore.data.samples import Array
from lipcore.kernels.drive.play import PlayState
from lipcore.online.batch import AHEAD_S, ARRAYS, Placement, Rows
from lipcore.vocabulary import Code
from service.journal.arrivals import NewBatch, note_arrival
from service.storage.database import EventRow, LearnerRow, LearningRow, StreamRow, fetch
from service.storage.rows import Page
from service.storage.rows import read_page as newest_rows

EventKind = Literal["batch", "replay", "unlearn", "rollback", "change", "settings", "payload"]
UNTIMED_CODES = [Code.NON_FINITE, Code.TIME_JUMP]
"""Codes of rows with an invalid time."""
WIDTHS, FIRST, DEFLECTIONS = "play/widths", "play/first", "play/deflections"
"""Arrays of the deflections in the safetensors archive of an event's rows: those of the first finite row, from which
the others follow, or those of every row."""


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
    """The time constants that events of the kind `settings` set."""

    forgetting_s: float | None = None
    """Time constant of forgetting, s; None if nothing is forgotten."""
    friction_walk_s: float | None = None
    """Time constant of drifting friction, s; None if friction does not drift."""

    def to_json(self) -> dict[str, Any]:
        """Return the JSON for an event."""
        walk = {} if self.friction_walk_s is None else {"friction_walk_s": self.friction_walk_s}
        return {"forgetting_s": self.forgetting_s} | walk

    @staticmethod
    def from_json(detail: dict[str, Any]) -> Memory:
        """Read what `to_json` wrote."""
        return Memory(detail["forgetting_s"], detail.get("friction_walk_s"))


def append_batch(
    session: Session, model: str, batch: NewBatch, max_streams: int | None = None
) -> tuple[EventRow, StreamRow]:
    """Log a batch and update the gaps of its stream. Return the event and the stream's row.

    The event is written with the session's next flush. The caller has checked with `find_batch`, in the same
    transaction, that the log has no batch of this sequence.

    Raise ConflictError if the stream is of another kind, or if frames do not follow the last one. Raise it also if the
    batch may have been learnt before and is no longer in the log. Raise BusyError beyond `max_streams` streams in use.
    """
    names = ("stream_id", "sequence", "last_sequence", "digest", "version", "revision", "report", "record")
    event = EventRow(number=newest(session, model) + 1, **{name: getattr(batch, name) for name in names})
    source = note_arrival(session, model, batch, max_streams)
    return _append(session, event, model, "batch", batch.received, batch.rows), source


def append(
    session: Session, model: str, kind: EventKind, detail: dict[str, Any], received: float, rows: Rows | None = None
) -> EventRow:
    """Log an event of any kind but `batch`, and return it."""
    event = _append(session, EventRow(number=newest(session, model) + 1, detail=detail), model, kind, received, rows)
    session.flush()
    return event


def find_batch(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """Return the batch with exactly this sequence."""
    return session.scalar(_of_stream(model, stream_id).where(EventRow.sequence == sequence))


def find_covering_batch(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """Return the batch that contains a sequence: its own, or that of one of its frames."""
    query = _of_stream(model, stream_id).where(EventRow.sequence <= sequence).order_by(EventRow.sequence.desc())
    event = session.scalar(query.limit(1))
    return event if event is not None and event.last_sequence is not None and sequence <= event.last_sequence else None


@dataclass(frozen=True)
class StreamHistory:
    """The logged batches of a stream around a sequence."""

    source: StreamRow | None
    """Row of the stream; None if the stream is new."""
    same: EventRow | None = None
    """Batch with exactly this sequence."""
    below: EventRow | None = None
    """Nearest batch with a lower sequence, adjacent or not."""
    above: EventRow | None = None
    """Nearest batch with a higher sequence, adjacent or not."""


def read_history(session: Session, model: str, stream_id: str, sequence: int) -> StreamHistory:
    """Read the logged batches of a stream around a sequence."""
    source = stream(session, model, stream_id)
    if source is None:
        return StreamHistory(None)
    place = {"model": model, "stream_id": stream_id, "sequence": sequence}
    below = session.scalar(_BEFORE, place)
    if sequence > source.last:  # most batches are the last of their stream: skip two queries
        return StreamHistory(source, None, below)
    return StreamHistory(source, find_batch(session, model, stream_id, sequence), below, session.scalar(_AFTER, place))


def find_adjacent_window(session: Session, model: str, stream_id: str, sequence: int) -> int | None:
    """Return the derivation window of a batch adjacent to a sequence, see `Placement`; None if none was derived."""
    for other in (sequence - 1, sequence + 1):
        if (event := _derived(session, model, stream_id, other)) is not None:
            return Placement.from_json(event.report or {}).window
    return None


def read_adjacent_rows(session: Session, model: str, stream_id: str, sequence: int, way: int, count: int) -> list[Rows]:
    """Return up to `count` rows with derived accelerations after (way 1) or before (way −1) a sequence, in order.

    Reading stops at the first gap of sequences.
    """
    parts: list[Rows] = []
    while count > 0:
        sequence += way
        event = _derived(session, model, stream_id, sequence)
        if event is None:
            break
        own = Placement.from_json(event.report or {}).own
        part = rows_of(event).take(slice(*own))  # without the rows of neighbours that this batch completed
        parts.append(part.take(slice(0, count) if way > 0 else slice(max(len(part) - count, 0), None)))
        count -= len(part)
    return parts[::way]


def _derived(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """Return the batch of a sequence if its accelerations were derived and it is not undone."""
    event = find_batch(session, model, stream_id, sequence)
    if event is None or event.void or event.report is None:
        return None
    return event if Placement.from_json(event.report).window is not None else None


def stream(session: Session, model: str, stream_id: str) -> StreamRow | None:
    """Return the row of a stream."""
    return session.get(StreamRow, (model, stream_id))


def newest(session: Session, model: str) -> int:
    """Return the number of the newest event, 0 if the log is empty."""
    return fetch(session, _NEWEST, model=model).scalar() or 0


def events(session: Session, model: str, after: int, limit: int, void: bool = False) -> list[EventRow]:
    """Return up to `limit` events above number `after` in rising order, with their rows.

    void: include events that were undone.
    """
    query = select(EventRow).where(EventRow.model == model, EventRow.number > after).order_by(EventRow.number)
    if not void:
        query = query.where(EventRow.void.is_(False))
    return list(session.scalars(query.limit(limit).options(undefer(EventRow.payload))))


def is_complete(session: Session, model: str, after: int, through: int) -> bool:
    """Return whether the log has every event with after < number <= through."""
    span = (EventRow.model == model, EventRow.number > after, EventRow.number <= through)
    return session.scalar(select(func.count()).select_from(EventRow).where(*span)) == max(through - after, 0)


def page(
    session: Session, model: str, part: Page, stream_id: str | None = None, rejected: bool = False
) -> tuple[list[EventRow], str | None]:
    """Return the batches of a page, newest first, and the cursor after it.

    rejected: return only batches with rows that are not learnt.
    """
    conditions = [EventRow.model == model, EventRow.kind == "batch"]
    if stream_id is not None:
        conditions.append(EventRow.stream_id == stream_id)
    if rejected:
        conditions.append(EventRow.learnt < EventRow.rows)
    return newest_rows(session, EventRow, part, *conditions)


def find_related(session: Session, batch: EventRow, kind: Literal["replay", "unlearn"]) -> Sequence[EventRow]:
    """Return the replays or the unlearning of a batch in order, including those undone since."""
    query = select(EventRow).where(
        EventRow.model == batch.model,
        EventRow.number > batch.number,
        EventRow.kind == kind,
        EventRow.detail["event"].as_integer() == batch.number,
    )
    return session.scalars(query.order_by(EventRow.number)).all()


def rows_of(event: EventRow) -> Rows:
    """Read the rows of a batch or a replay."""
    assert event.payload is not None  # batches and replays have one
    return decode(event.payload)


def memory(session: Session, model: str, number: int) -> Memory:
    """Return the time constants that apply after event `number`."""
    query = select(EventRow.detail).where(
        EventRow.model == model, EventRow.number <= number, EventRow.kind == "settings", EventRow.void.is_(False)
    )
    detail = session.scalar(query.order_by(EventRow.number.desc()).limit(1))
    return Memory() if detail is None else Memory.from_json(detail)


def start_of(session: Session, model: str, version: int) -> int:
    """Return the number of the last event that the training of a version used; 0 if it used none."""
    return fetch(session, _START, model=model, version=version).scalar() or 0


def clock(session: Session, model: str, received: float) -> float:
    """Return the time of a model's own clock at an arrival, Unix time, s.

    The clock advances with arrivals and never runs back. In a pause it advances by at most the shortest time constant
    that is set. A host clock that is wrong, or is corrected, therefore cannot make the model forget more.
    """
    latest = session.execute(_LATEST, {"model": model}).first()
    if latest is None:
        return received
    options = fetch(session, _OPTIONS, model=model).scalar() or {}
    constants = [options.get(name) for name in ("forgetting_s", "friction_walk_s")]
    longest = min((each for each in constants if each is not None), default=math.inf)
    before, last = latest
    return (before if last is None else last) + min(max(received - before, 0.0), longest)


def learning_time(event: EventRow, time: Array | float) -> Array:
    """Return the event times of an event by the model's own clock, s.

    The age of each row at its arrival stays. No time is later than the arrival by more than `AHEAD_S`.
    """
    if event.clock is None:  # logged by an earlier release
        return np.asarray(time)
    return np.asarray(event.clock + np.minimum(time - event.received, AHEAD_S))


def learning_rows(event: EventRow) -> Rows:
    """Read the rows of a batch or a replay, with times by the model's own clock."""
    rows = rows_of(event)
    # a replay was logged with times of that clock: its rows are as old as their batch
    return rows if event.kind == "replay" else replace(rows, time=learning_time(event, rows.time))


def count_pending(session: Session, model: str, after: int) -> tuple[int, float | None]:
    """Return how many rows after event `after` are to be learnt, and when the first arrived, Unix time, s, or None."""
    later = EventRow.model == model, EventRow.number > after, EventRow.learnt > 0, EventRow.void.is_(False)
    rows, arrived = session.execute(select(func.sum(EventRow.learnt), func.min(EventRow.received)).where(*later)).one()
    return int(rows or 0), arrived


def encode(rows: Rows) -> bytes:
    """Return rows as safetensors; `decode` returns the same rows, bit for bit."""
    return save({name: np.ascontiguousarray(each) for name, each in _arrays(rows).items()})


def decode(data: bytes) -> Rows:
    """Read what `encode` wrote; raise ValueError if it is damaged."""
    try:
        arrays = load(data)
    except SafetensorError as error:
        raise ValueError(f"logged rows cannot be read: {error}") from None
    known = set(arrays) - {WIDTHS, FIRST, DEFLECTIONS}
    if known != set(ARRAYS):
        raise ValueError(f"logged rows have the arrays {', '.join(sorted(arrays))}, expected {', '.join(ARRAYS)}")
    own = {name: arrays[name] for name in ARRAYS}
    rows = Rows(**own, deflections=arrays.get(DEFLECTIONS), widths=arrays.get(WIDTHS))
    return rows if FIRST not in arrays else follow_first(rows, arrays[FIRST], arrays[WIDTHS])


def follow_first(rows: Rows, deflections: Array, widths: Array) -> Rows:
    """Return rows with the deflections that follow from those of the first finite row, (2 K, n)."""
    first = _first_finite(rows)
    return rows.followed(PlayState.at(float(rows.time[first]), rows.q[first], rows.dq[first], deflections), widths)[0]


def _first_finite(rows: Rows) -> int:
    """Return the place of the first row with finite time, position and velocity; 0 if there is none."""
    numbers = np.hstack([rows.time[:, None], rows.q, rows.dq])
    return int(np.isfinite(numbers).all(axis=1).argmax())


def _arrays(rows: Rows) -> dict[str, NDArray[Any]]:
    own = {name: getattr(rows, name) for name in ARRAYS}
    if rows.deflections is None or rows.widths is None:
        return own
    first = rows.deflections[_first_finite(rows)]
    followed = follow_first(rows, first, rows.widths).deflections
    # rows that were taken from a batch do not follow from their first
    if followed is not None and np.array_equal(followed, rows.deflections):
        return {**own, WIDTHS: rows.widths, FIRST: first}
    return {**own, WIDTHS: rows.widths, DEFLECTIONS: rows.deflections}


def _of_stream(model: str, stream_id: str) -> Select[EventRow]:
    return select(EventRow).where(EventRow.model == model, EventRow.stream_id == stream_id)


def _append(
    session: Session, event: EventRow, model: str, kind: EventKind, received: float, rows: Rows | None
) -> EventRow:
    event.model, event.kind, event.received = model, kind, received
    event.clock = clock(session, model, received)
    if rows is not None:
        event.payload, event.rows, event.learnt = encode(rows), len(rows), int(np.sum(rows.code == Code.LEARNT))
        times = rows.time[np.isfinite(rows.time) & ~np.isin(rows.code, UNTIMED_CODES)]
        if len(times):
            event.first, event.last = float(times.min()), float(times.max())
    session.add(event)
    return event
