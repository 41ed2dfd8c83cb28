"""Snapshots of what a version had learnt, which make a restart short and a rollback possible; and the log kept within
its size and age, without losing what a learning version is still to learn."""

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
from service.storage.errors import undecided
from service.storage.files import Files, new_id


def save(
    database: Database, files: Files, model: str, version: int, number: int, seen: int, payload: bytes, *, most: int
) -> str | None:
    """Store a version's state after event `number` durably and return its id; thin what is kept to `most`.

    seen: the event up to which undoing is taken into account. None, and nothing is stored, where what the state
    contains has been undone since, and where the version has been deleted.
    """
    snapshot = new_id("snap")
    digest = files.write_snapshot(snapshot, payload)
    try:
        with database.transaction(model) as session:
            outdated = _is_outdated(session, model, version, number, seen)
            gone = [snapshot] if outdated else _add(session, snapshot, digest, model, version, number, most)
    except SQLAlchemyError as error:
        if not undecided(error):
            files.delete_snapshot(snapshot)
        raise
    for name in gone:  # only after the commit: until then the rows still name them
        files.delete_snapshot(name)
    return None if outdated else snapshot


def sweep(database: Database, files: Files) -> int:
    """Delete the files that an interrupted `save` has left; return how many. Only for the process that saves."""
    with database.session() as session:
        named = set(session.scalars(select(SnapshotRow.id)))
    return files.sweep_snapshots(named)


def latest(session: Session, model: str, version: int, at_most: int | None) -> SnapshotRow | None:
    """The snapshot of a version with the highest number, up to `at_most` where given."""
    query = _of(model, version) if at_most is None else _of(model, version).where(SnapshotRow.number <= at_most)
    return session.scalar(query.limit(1))


def of(session: Session, model: str, version: int) -> list[SnapshotRow]:
    """The snapshots of a version, that with the highest number first."""
    return list(session.scalars(_of(model, version)))


def last_stored(session: Session, model: str, version: int) -> tuple[str, float] | None:
    """Id of the snapshot of a version that was stored last, by whichever service, and when: Unix time, s."""
    query = select(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.version == version)
    row = session.scalar(query.order_by(SnapshotRow.seq.desc()).limit(1))
    return None if row is None else (row.id, datetime.fromisoformat(row.created_at).timestamp())


def read(files: Files, row: SnapshotRow) -> bytes:
    """What was stored; raise DamagedFileError where its file is another one, or lost."""
    return files.read_snapshot(row.id, row.sha256)


def thinned(numbers: Sequence[int], most: int) -> list[int]:
    """Places of the snapshots to keep where they stand at these falling numbers, at most `most` >= 2.

    The newest half stays and so does the oldest. Of the others those go whose neighbours are closest together, so that
    what is left reaches back in even steps.
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
    """Whether part of a state has been undone, or the version is no more."""
    if session.get(VersionRow, (model, version)) is None:
        return True
    return undo.must_fold_again(session, model, version, seen, number)


def _add(session: Session, snapshot: str, digest: str, model: str, version: int, number: int, most: int) -> list[str]:
    """Add a snapshot's row; return the ids of those that gave way to it."""
    rows = of(session, model, version)
    row = SnapshotRow(id=snapshot, model=model, version=version, number=number, created_at=now(), sha256=digest)
    session.add(row)
    others = [row for row in rows if row.number != number]
    numbers = sorted([number, *(row.number for row in others)], reverse=True)
    kept = {numbers[place] for place in thinned(numbers, most)}
    gone = [row.id for row in rows if row.number == number or row.number not in kept]
    session.execute(delete(SnapshotRow).where(SnapshotRow.id.in_(gone)))
    return gone


CHUNK = 200
"""Events deleted in one transaction, so that observations do not wait long for the lock."""


def retain(database: Database, settings: Settings, model: str, now: float) -> int:
    """Delete the oldest events of a model that are too old or too many; return how many batches and replays went.

    now: Unix time, s. Events stay, whatever their age, while a learning version has no snapshot that contains them. So
    do settings, which say what a rollback returns to, and the newest event, which the
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
    """Number of the newest event that the version that learns has learnt for good, by training or in a snapshot."""
    version = registry.answering(session, model)
    if version is None:
        return 0
    row = latest(session, model, version, None)
    return log.start_of(session, model, version) if row is None else row.number


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
    return [EventRow.model == model, EventRow.number <= through, not_(in_force)]


def _forget(session: Session, event: EventRow) -> None:
    """Note in the row of a batch's stream that it cannot be known again."""
    if event.kind == "batch":
        source = session.get(StreamRow, (event.model, event.stream_id))
        if source is None:  # it has made room for others
            return
        known = [last for last in (source.forgotten, event.last_sequence) if last is not None]
        source.forgotten = max(known)
