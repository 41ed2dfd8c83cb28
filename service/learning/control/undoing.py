"""Taking back what was learnt: one batch, or everything since a revision that can be made again."""

from __future__ import annotations

import time
from collections.abc import Iterator

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, invalid_request, problem
from service.journal import log
from service.journal.log import EventKind
from service.learning.control import inspection
from service.learning.control.schema import Revised, RollbackRequest, RolledBack, Unlearnt
from service.learning.ingest.batches import state
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import Database, EventRow, LearnerRow, SnapshotRow
from service.web.rows import Page

Range = tuple[int, int]
PAGE = 100
ROLLBACKS: tuple[EventKind] = ("rollback",)
WORDS = {"unlearnt": "has been unlearnt", "rolled_back": "was undone by a rollback"}


def serving(database: Database, model: str) -> int:
    """Return the version that answers where none is named; raise NotFoundError for an unknown model."""
    return registry.find(database, model, None).version


def current(session: Session, model: str, version: int) -> int:
    """Return the revision of a version once all of the log is learnt."""
    return log.newest(session, model) - log.start_of(session, model, version)


def revised_now(session: Session, model: str, version: int) -> Revised:
    """Return the revision of a version that contains everything logged so far."""
    return Revised(model=model, version=version, revision=current(session, model, version))


def snapshots(session: Session, model: str, version: int) -> list[SnapshotRow]:
    """Return the stored states of a version, newest first."""
    query = select(SnapshotRow).where(SnapshotRow.model == model, SnapshotRow.version == version)
    return list(session.scalars(query.order_by(SnapshotRow.number.desc())))


def reachable(session: Session, model: str, version: int) -> list[Range]:
    """Return the ranges [first, last] of revisions whose state can be made again, rising.

    That takes the version as trained, or a snapshot, and all events from there; and no rollback may have gone back
    behind it since: the events that a rollback has undone teach nothing any more, so that their states are gone.
    """
    start, newest = log.start_of(session, model, version), log.newest(session, model)
    bases = sorted({start, *(row.number for row in snapshots(session, model, version) if row.number > start)})
    ranges: list[Range] = []
    for base, following in zip(bases, [*bases[1:], newest + 1], strict=True):
        last = following - 1
        ranges.append((base, last if log.is_complete(session, model, base, last) else base))
    for event in _rollbacks(session, model):
        to = (event.detail or {})["to"]
        ranges = [part for each in ranges for part in _without(each, to + 1, event.number - 1)]
    return _joined([(first - start, last - start) for first, last in ranges])


def find_learnt(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch of exactly this sequence; raise NotFoundError, or ConflictError where it was undone."""
    batch = inspection.find(session, model, stream_id, sequence)
    if batch.sequence != sequence:
        together = f"{batch.sequence}: frames {batch.sequence} to {batch.last_sequence} were logged together"
        raise invalid_request("sequence", sequence, together)
    if batch.void:
        raise ConflictError(f"batch {sequence} of stream {stream_id!r} {WORDS[state(session, batch)]}")
    return batch


def unlearn(learners: Learners, model: str, stream_id: str, sequence: int) -> Unlearnt:
    """Take a batch and what was replayed of it out again; raise NotFoundError or ConflictError."""
    version = serving(learners.database, model)
    with learners.database.turn(model), learners.database.transaction(model) as session:
        batch = find_learnt(session, model, stream_id, sequence)
        rows = batch.learnt + sum(each.learnt for each in inspection.replays(session, batch) if not each.void)
        trained = select(LearnerRow.version).where(LearnerRow.model == model, LearnerRow.start >= batch.number)
        versions = list(session.scalars(trained.order_by(LearnerRow.version)))
        log.unlearn(session, model, batch, time.time())
        revised = revised_now(session, model, version)
    learners.process.wake(model)
    return Unlearnt(**revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=rows, trained=versions)


def rollback(learners: Learners, model: str, request: RollbackRequest) -> RolledBack:
    """Go back to a revision of the version that serves, or to another version.

    Raise NotFoundError, InvalidRequestError where not exactly one of the two is named or it is not older than what
    serves, ConflictError where nothing reaches back as far.
    """
    if (request.revision is None) == (request.version is None):
        given = "neither" if request.revision is None else "both"
        raise invalid_request("revision or version", given, "exactly one of the two")
    if request.version is not None:
        return _to_version(learners, model, request.version)
    assert request.revision is not None
    return _to_revision(learners, model, request.revision)


def _to_revision(learners: Learners, model: str, revision: int) -> RolledBack:
    version = serving(learners.database, model)
    with learners.database.turn(model), learners.database.transaction(model) as session:
        newest = current(session, model, version)
        if revision >= newest:
            raise invalid_request("revision", revision, f"one below {newest}, the newest of version {version}")
        _check_reach(revision, version, reachable(session, model, version))
        to = log.start_of(session, model, version) + revision
        undone = select(func.count()).where(
            EventRow.model == model,
            EventRow.number > to,
            EventRow.kind.in_(("batch", "replay")),
            EventRow.void.is_(False),
        )
        count = session.scalar(undone) or 0
        log.rollback(session, model, to, time.time())
        revised = revised_now(session, model, version)
    learners.process.wake(model)
    return RolledBack(**revised.model_dump(), undone=count, complete=True)


def _check_reach(revision: int, version: int, ranges: list[Range]) -> None:
    """Raise ConflictError, naming the revisions that can be returned to, where this one is none of them."""
    if _is_reached(revision, ranges):
        return
    oldest = next((first for first, last in ranges if last > 0), 0)
    listed = ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in ranges)
    raise ConflictError(
        f"revision {revision} of version {version} cannot be made again: no snapshot is as old and the log does not "
        f"reach back, or a rollback has undone it. The oldest that can, but for 0 as trained, is {oldest}",
        [problem("revision", revision, f"one of {listed}")],
    )


def _is_reached(revision: int, ranges: list[Range]) -> bool:
    return any(first <= revision <= last for first, last in ranges)


def _to_version(learners: Learners, model: str, version: int) -> RolledBack:
    if version == serving(learners.database, model):
        raise ConflictError(f"version {version} of model {model!r} serves already")
    learners.loaded.get(model, version)  # so that the change costs no query anything, or fails before it is made
    with learners.database.transaction() as session:
        registry.serve(session, model, version)
        revised = revised_now(session, model, version)
        complete = _is_reached(revised.revision, reachable(session, model, version))
    learners.loaded.adopt(model)
    learners.process.wake(model)
    return RolledBack(**revised.model_dump(), undone=0, complete=complete)


def _rollbacks(session: Session, model: str) -> Iterator[EventRow]:
    cursor: str | None = None
    while True:
        part = Page(after=None if cursor is None else int(cursor), limit=PAGE)
        events, cursor = log.page(session, model, part, kinds=ROLLBACKS)
        yield from events
        if cursor is None:
            return


def _without(span: Range, first: int, last: int) -> Iterator[Range]:
    """The parts of a range that are left once first to last are taken out."""
    for a, b in ((span[0], min(span[1], first - 1)), (max(span[0], last + 1), span[1])):
        if a <= b:
            yield a, b


def _joined(ranges: list[Range]) -> list[Range]:
    """The same numbers in as few ranges as there can be."""
    joined: list[Range] = []
    for first, last in sorted(ranges):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return joined
