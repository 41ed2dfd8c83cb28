"""The one way to undo: mark events void, delete the snapshots that contain them, fold the log again.

Functions that write are called inside `Database.transaction()`, like those of `log`.
"""

from __future__ import annotations

import logging
from dataclasses import asdict

from sqlalchemy import ColumnElement, delete, func, select, update
from sqlalchemy.orm import Session

from service.journal import log
from service.storage.database import EventRow, LearningRow, ServingRow, SnapshotRow

logger = logging.getLogger(__name__)


def unlearn(session: Session, model: str, event: EventRow, received: float) -> EventRow:
    """Mark a batch and its replays void and delete the snapshots that contain them; return the new event.

    Snapshots stay if the log is too short to fold it again without the batch. The batch then stays in them.
    """
    storing = select(SnapshotRow.version).where(SnapshotRow.model == model, SnapshotRow.number >= event.number)
    serving = select(ServingRow.version).where(ServingRow.model == model)
    for version in session.scalars(storing.union(serving)).all():
        if log.start_of(session, model, version) >= event.number:
            continue
        if can_fold_again(session, model, version, event.number):
            _delete_snapshots(session, model, event.number, SnapshotRow.version == version)
        else:
            name = f"batch {event.sequence} of stream {event.stream_id!r}"
            logger.error("could not unlearn %s of model %r: the log lacks earlier batches", name, model)
    numbers = [event.number, *(each.number for each in log.find_related(session, event, "replay"))]
    session.execute(update(EventRow).where(EventRow.model == model, EventRow.number.in_(numbers)).values(void=True))
    return log.append(session, model, "unlearn", {"event": event.number}, received)


def rollback(session: Session, model: str, to: int, received: float) -> EventRow:
    """Mark the events after `to` void and delete the snapshots that contain them; return the new event.

    These are batches, replays, changes and settings, for every version. Unlearnt batches stay unlearnt.
    """
    made = ("batch", "replay", "change", "settings")
    later = (EventRow.model == model, EventRow.number > to)
    session.execute(update(EventRow).where(*later, EventRow.kind.in_(made), EventRow.void.is_(False)).values(void=True))
    _delete_snapshots(session, model, to + 1)
    event = log.append(session, model, "rollback", {"to": to}, received)
    settings = session.get(LearningRow, model)
    if settings is not None:
        settings.options = {**settings.options, **asdict(log.memory(session, model, to))}
    return event


def must_fold_again(session: Session, model: str, version: int, seen: int, through: int) -> bool:
    """Return whether a state up to event `through` must be folded again after undoing since event `seen`.

    It must if it contains events that have been undone since and can be made without them.

    Events that the training of the version used stay.
    """
    later = (EventRow.model == model, EventRow.number > seen, EventRow.kind.in_(("unlearn", "rollback")))
    start = log.start_of(session, model, version)
    for kind, detail in session.execute(select(EventRow.kind, EventRow.detail).where(*later)).all():
        if kind == "rollback" and detail["to"] < through:
            return True
        contained = kind == "unlearn" and start < detail["event"] <= through
        if contained and can_fold_again(session, model, version, detail["event"]):
            return True
    return False


def can_fold_again(session: Session, model: str, version: int, first: int) -> bool:
    """Return whether the state of a version can be reconstructed without the events from `first` on.

    This needs all events since the newest snapshot before `first`, or since the training.
    """
    before = (SnapshotRow.model == model, SnapshotRow.version == version, SnapshotRow.number < first)
    base = session.scalar(select(func.max(SnapshotRow.number)).where(*before))
    base = log.start_of(session, model, version) if base is None else base
    return log.is_complete(session, model, base, log.newest(session, model))


def _delete_snapshots(session: Session, model: str, first: int, *of_version: ColumnElement[bool]) -> None:
    session.execute(delete(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.number >= first, *of_version))
