"""Keeping the log within its size and age, without losing what a learning version is still to learn."""

from __future__ import annotations

from sqlalchemy import ColumnElement, and_, delete, func, not_, select
from sqlalchemy.orm import Session

from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.models import registry
from service.storage.database import Database, EventRow, StreamRow

CHUNK = 200
"""Events deleted in one transaction, so that observations do not wait long for the lock."""


def retain(database: Database, settings: Settings, model: str, now: float) -> int:
    """Delete the oldest events of a model that are too old or too many; return how many batches and replays went.

    now: Unix time, s. Events stay, whatever their age, while a learning version has no snapshot that contains them or
    has still to unlearn them. So do settings, which say what a rollback returns to, and the newest event, which the
    next number follows.
    """
    gone = 0
    while True:
        with database.session() as session:  # the search takes long, and no lock
            chosen = _chosen(session, settings, model, now)
        if not chosen:
            return gone
        with database.transaction(model) as session:
            of_chosen = select(EventRow).where(EventRow.seq.in_(chosen), *_deletable(session, model))
            events = list(session.scalars(of_chosen))
            for event in events:
                _forget(session, event)
            session.execute(delete(EventRow).where(EventRow.seq.in_([event.seq for event in events])))
        if not events:
            return gone  # what was chosen is needed after all, or another call has deleted it
        gone += sum(event.kind in ("batch", "replay") for event in events)


def contained(session: Session, model: str) -> int:
    """Number of the newest event that every learning version has learnt for good, by training or in a snapshot."""
    through = []
    for version in registry.learning(session, model):
        row = snapshots.latest(session, model, version, None)
        through.append(log.start_of(session, model, version) if row is None else row.number)
    return min(through, default=0)


def _chosen(session: Session, settings: Settings, model: str, now: float) -> list[int]:
    """Places in the table of the oldest events that are to go next, at most CHUNK."""
    size = func.coalesce(func.length(EventRow.payload), 0)
    held = session.scalar(select(func.sum(size)).where(EventRow.model == model)) or 0
    excess = held - settings.observation_retention_bytes
    query = select(EventRow.seq, EventRow.received, size).where(*_deletable(session, model))
    chosen: list[int] = []
    for seq, received, length in session.execute(query.order_by(EventRow.number).limit(CHUNK)):
        if excess <= 0 and received >= now - settings.observation_retention_s:
            break
        excess -= length
        chosen.append(seq)
    return chosen


def _deletable(session: Session, model: str) -> list[ColumnElement[bool]]:
    """Conditions of the events that nothing needs."""
    through = min(contained(session, model), log.newest(session, model) - 1)
    in_force = and_(EventRow.kind == "settings", EventRow.void.is_(False))
    within = [EventRow.model == model, EventRow.number <= through, not_(in_force)]
    pending = select(EventRow).where(EventRow.model == model, EventRow.number > through, EventRow.kind == "unlearn")
    if batches := {batch for event in session.scalars(pending) if (batch := _batch(event)) is not None}:
        replays = session.scalars(select(EventRow).where(*within, EventRow.kind == "replay"))
        needed = batches | {event.number for event in replays if _batch(event) in batches}
        rollbacks = select(EventRow.number).where(*within, EventRow.kind == "rollback", EventRow.number > min(batches))
        needed |= set(session.scalars(rollbacks))  # they tell which of the replays are learnt
        within.append(EventRow.number.not_in(needed))
    return within


def _batch(event: EventRow) -> int | None:
    """Number of the batch that an event is about."""
    return (event.detail or {}).get("event")


def _forget(session: Session, event: EventRow) -> None:
    """Note in the row of a batch's stream that it cannot be known again."""
    if event.kind == "batch":
        source = session.get_one(StreamRow, (event.model, event.stream_id))
        known = [last for last in (source.forgotten, event.last_sequence) if last is not None]
        source.forgotten = max(known)
