"""Revisions of a version: which one the log leads to, and which ones a rollback can return to."""

from __future__ import annotations

from collections.abc import Iterator

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.journal import log
from service.journal.log import EventKind
from service.learning.control.schema import Revised
from service.models import registry
from service.storage.database import Database, EventRow, SnapshotRow
from service.web.pagination import Page

Range = tuple[int, int]
PAGE = 100
ROLLBACKS: tuple[EventKind] = ("rollback",)


def serving(database: Database, model: str) -> int:
    """Return the version that answers where none is named; raise NotFoundError for an unknown model."""
    return registry.find(database, model, None).version


def current(session: Session, model: str, version: int) -> int:
    """Return the revision of a version once all of the log is learnt."""
    return log.newest(session, model) - log.start_of(session, model, version)


def revised(session: Session, model: str, version: int) -> Revised:
    """Return the revision of a version that contains everything logged so far."""
    return Revised(model=model, version=version, revision=current(session, model, version))


def snapshots(session: Session, model: str, version: int) -> list[SnapshotRow]:
    """Return the stored states of a version, newest first."""
    query = select(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.version == version)
    return list(session.scalars(query.order_by(SnapshotRow.number.desc())))


def reachable(session: Session, model: str, version: int) -> list[Range]:
    """Return the ranges [first, last] of revisions whose state can be made again, rising.

    A revision can where the version as trained, or a snapshot, and all events from there are kept, and no rollback has
    gone back behind it since: what a rollback has undone teaches nothing any more, so its state is gone.
    """
    start, newest = log.start_of(session, model, version), log.newest(session, model)
    bases = sorted({start, *(row.number for row in snapshots(session, model, version) if row.number > start)})
    found: list[Range] = []
    for base, following in zip(bases, [*bases[1:], newest + 1], strict=True):
        last = following - 1
        found.append((base, last if log.is_complete(session, model, base, last) else base))
    for event in _rollbacks(session, model):
        to = (event.detail or {})["to"]
        found = [part for each in found for part in _without(each, to + 1, event.number - 1)]
    return _joined([(first - start, last - start) for first, last in found])


def _rollbacks(session: Session, model: str) -> Iterator[EventRow]:
    cursor: str | None = None
    while True:
        part = Page(after=None if cursor is None else int(cursor), limit=PAGE)
        events, cursor = log.page(session, model, part, kinds=ROLLBACKS)
        yield from events
        if cursor is None:
            return


def _without(whole: Range, first: int, last: int) -> Iterator[Range]:
    """What is left of a range once first to last are taken out."""
    for a, b in ((whole[0], min(whole[1], first - 1)), (max(whole[0], last + 1), whole[1])):
        if a <= b:
            yield a, b


def _joined(ranges: list[Range]) -> list[Range]:
    """The same numbers in as few ranges as there can be."""
    out: list[Range] = []
    for first, last in sorted(ranges):
        if out and first <= out[-1][1] + 1:
            out[-1] = (out[-1][0], max(last, out[-1][1]))
        else:
            out.append((first, last))
    return out
