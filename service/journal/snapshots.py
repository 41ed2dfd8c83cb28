"""Snapshots of learnt states, and the retention of the log.

Snapshots make a restart short and a rollback possible. Retention limits the log's size and age. It deletes no event
that a learning version still has to learn.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import ColumnElement, Select, and_, delete, func, not_, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.foundation.settings import Settings
from service.journal import log, undo
from service.models import registry
from service.storage.database import Database, EventRow, SnapshotRow, StreamRow, VersionRow, now
from service.storage.errors import is_undecided
from service.storage.files import Files, new_id


def save(
    database: Database, files: Files, model: str, version: int, number: int, seen: int, payload: bytes, *, most: int
) -> str | None:
    """Store a version's state after event `number` durably, delete snapshots beyond `most`, and return the id.

    seen: last event up to which undoing is taken into account. Return None and store nothing if the version has been
    deleted, or if events in the state have been undone since.
    """
    snapshot = new_id("snap")
    digest = files.write_snapshot(snapshot, payload)
    try:
        with database.transaction(model) as session:
            outdated = _is_outdated(session, model, version, number, seen)
            gone = [snapshot] if outdated else _add(session, snapshot, digest, model, version, number, most)
    except SQLAlchemyError as error:
        if not is_undecided(error):
            files.delete_snapshot(snapshot)
        raise
    for name in gone:  # after the commit: until then the rows refer to them
        files.delete_snapshot(name)
    return None if outdated else snapshot


def sweep(database: Database, files: Files) -> int:
    """Delete the files of an interrupted `save` and return how many. Only the process that saves may call it."""
    with database.session() as session:
        named = set(session.scalars(select(SnapshotRow.id)))
    return files.sweep_snapshots(named)


def find_latest(session: Session, model: str, version: int, at_most: int | None) -> SnapshotRow | None:
    """Return the snapshot of a version with the highest number, at most `at_most` if given."""
    query = _of(model, version) if at_most is None else _of(model, version).where(SnapshotRow.number <= at_most)
    return session.scalar(query.limit(1))


def list_snapshots(session: Session, model: str, version: int) -> list[SnapshotRow]:
    """Return the snapshots of a version in falling order of their numbers."""
    return list(session.scalars(_of(model, version)))


def find_last_stored(session: Session, model: str, version: int) -> tuple[str, float] | None:
    """Return the id of the version's snapshot that any service stored last, and its Unix time, s."""
    query = select(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.version == version)
    row = session.scalar(query.order_by(SnapshotRow.seq.desc()).limit(1))
    return None if row is None else (row.id, datetime.fromisoformat(row.created_at).timestamp())


def read(files: Files, row: SnapshotRow) -> bytes:
    """Read a snapshot; raise DamagedFileError if its file is lost or does not match."""
    return files.read_snapshot(row.id, row.sha256)


def choose_kept(numbers: Sequence[int], most: int) -> list[int]:
    """Return the indices of the snapshots to keep, at most `most` >= 2. `numbers` fall.

    The newest half and the oldest stay. Of the others, those with the closest neighbours go, so that the rest is spread
    evenly over the past.
    """
    kept = list(range(len(numbers)))
    while len(kept) > most:
        inner = range((most + 1) // 2, len(kept) - 1)
        kept.pop(min(inner, key=lambda place: numbers[kept[place - 1]] - numbers[kept[place + 1]]))
    return kept


def _of(model: str, version: int) -> Select[SnapshotRow]:
    of_version = select(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.version == version)
    return of_version.order_by(SnapshotRow.number.desc())


def _is_outdated(session: Session, model: str, version: int, number: int, seen: int) -> bool:
    """Return whether part of a state has been undone, or the version has been deleted."""
    if session.get(VersionRow, (model, version)) is None:
        return True
    return undo.must_fold_again(session, model, version, seen, number)


def _add(session: Session, snapshot: str, digest: str, model: str, version: int, number: int, most: int) -> list[str]:
    """Add the row of a snapshot and return the ids of the snapshots that it replaces."""
    rows = list_snapshots(session, model, version)
    row = SnapshotRow(id=snapshot, model=model, version=version, number=number, created_at=now(), sha256=digest)
    session.add(row)
    others = [row for row in rows if row.number != number]
    numbers = sorted([number, *(row.number for row in others)], reverse=True)
    kept = {numbers[place] for place in choose_kept(numbers, most)}
    gone = [row.id for row in rows if row.number == number or row.number not in kept]
    session.execute(delete(SnapshotRow).where(SnapshotRow.id.in_(gone)))
    return gone


CHUNK_EVENTS = 200
"""Events deleted in one transaction, so that observations do not wait long for the lock."""


def retain(database: Database, settings: Settings, model: str, now: float) -> int:
    """Delete the events of a model that exceed the limits; return how many batches and replays were deleted.

    now: Unix time, s. Events stay, whatever their age, while a learning version has no snapshot that contains them.
    Settings stay too, because a rollback restores them. So does the newest event, because the next number follows it.
    """
    gone = 0
    while True:
        with database.session() as session:  # the search takes long and needs no lock
            chosen = _chosen(session, settings, model, now)
        if not chosen:
            return gone
        with database.transaction(model) as session:
            of_chosen = select(EventRow).where(EventRow.seq.in_(chosen), *_deletable(session, model))
            events = list(session.scalars(of_chosen))
            for event in events:
                _note_forgotten(session, event)
            session.execute(delete(EventRow).where(EventRow.seq.in_([event.seq for event in events])))
        if not events:
            return gone  # another call has deleted the chosen events, or they are needed now
        gone += sum(event.kind in ("batch", "replay") for event in events)


def find_newest_contained(session: Session, model: str) -> int:
    """Return the number of the newest event that training of the serving version used or that a snapshot contains."""
    version = registry.serving_version(session, model)
    if version is None:
        return 0
    row = find_latest(session, model, version, None)
    return log.start_of(session, model, version) if row is None else row.number


def _chosen(session: Session, settings: Settings, model: str, now: float) -> list[int]:
    """Return the `seq` of the oldest events to delete next, at most `CHUNK_EVENTS`."""
    size = func.coalesce(func.length(EventRow.payload), 0)
    held = session.scalar(select(func.sum(size)).where(EventRow.model == model)) or 0
    excess = held - settings.observation_retention_bytes
    query = select(EventRow.seq, EventRow.received, size).where(*_deletable(session, model))
    chosen: list[int] = []
    for seq, received, length in session.execute(query.order_by(EventRow.number).limit(CHUNK_EVENTS)):
        if excess <= 0 and received >= now - settings.observation_retention_s:
            break
        excess -= length
        chosen.append(seq)
    return chosen


def _deletable(session: Session, model: str) -> list[ColumnElement[bool]]:
    """Return the conditions for events that no version needs."""
    through = min(find_newest_contained(session, model), log.newest(session, model) - 1)
    in_force = and_(EventRow.kind == "settings", EventRow.void.is_(False))
    return [EventRow.model == model, EventRow.number <= through, not_(in_force)]


def _note_forgotten(session: Session, event: EventRow) -> None:
    """Store in the row of the stream that repetitions of this batch can no longer be detected."""
    if event.kind == "batch":
        source = session.get(StreamRow, (event.model, event.stream_id))
        if source is None:  # deleted to make room for other streams
            return
        known = [last for last in (source.forgotten, event.last_sequence) if last is not None]
        source.forgotten = max(known)
