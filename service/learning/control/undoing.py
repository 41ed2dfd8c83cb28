"""Taking back what was learnt: one batch, or everything since a revision."""

from __future__ import annotations

import time

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, invalid_request, problem
from service.journal import log
from service.learning.control import inspection, revisions
from service.learning.control.revisions import Range
from service.learning.control.schema import RollbackRequest, RolledBack, Unlearnt
from service.learning.ingest import identity
from service.learning.updates import Updates
from service.models import registry
from service.storage.database import EventRow, LearnerRow

WORDS = {"unlearnt": "has been unlearnt", "rolled_back": "was undone by a rollback"}


def find_learnt(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch of exactly this sequence; raise NotFoundError, or ConflictError where it was undone."""
    batch = inspection.find(session, model, stream_id, sequence)
    if batch.sequence != sequence:
        together = f"{batch.sequence}: frames {batch.sequence} to {batch.last_sequence} were logged together"
        raise invalid_request("sequence", sequence, together)
    if batch.void:
        raise ConflictError(f"batch {sequence} of stream {stream_id!r} {WORDS[identity.state(session, batch)]}")
    return batch


def unlearn(updates: Updates, model: str, stream_id: str, sequence: int) -> Unlearnt:
    """Take a batch and what was replayed of it out again; raise NotFoundError or ConflictError."""
    version = revisions.serving(updates.database, model)
    with updates.database.turn(model), updates.database.transaction(model) as session:
        batch = find_learnt(session, model, stream_id, sequence)
        rows = batch.learnt + sum(each.learnt for each in inspection.replays(session, batch) if not each.void)
        trained = select(LearnerRow.version).where(LearnerRow.model == model, LearnerRow.start >= batch.number)
        versions = list(session.scalars(trained.order_by(LearnerRow.version)))
        log.unlearn(session, model, batch, time.time())
        revised = revisions.revised(session, model, version)
    updates.learner.wake(model)
    return Unlearnt(**revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=rows, trained=versions)


def rollback(updates: Updates, model: str, request: RollbackRequest) -> RolledBack:
    """Go back to a revision of the version that serves, or to another version.

    Raise NotFoundError, InvalidRequestError where not exactly one of the two is named or it is not older than what
    serves, ConflictError where nothing reaches back as far.
    """
    if (request.revision is None) == (request.version is None):
        found = "neither" if request.revision is None else "both"
        raise invalid_request("revision or version", found, "exactly one of the two")
    if request.version is not None:
        return _to_version(updates, model, request.version)
    assert request.revision is not None
    return _to_revision(updates, model, request.revision)


def _to_revision(updates: Updates, model: str, revision: int) -> RolledBack:
    version = revisions.serving(updates.database, model)
    with updates.database.turn(model), updates.database.transaction(model) as session:
        newest = revisions.current(session, model, version)
        if revision >= newest:
            raise invalid_request("revision", revision, f"one below {newest}, the newest of version {version}")
        _check_reach(revision, version, revisions.reachable(session, model, version))
        to = log.start_of(session, model, version) + revision
        undone = select(func.count()).where(
            EventRow.model == model,
            EventRow.number > to,
            EventRow.kind.in_(("batch", "replay")),
            EventRow.void.is_(False),
        )
        count = session.scalar(undone) or 0
        log.rollback(session, model, to, time.time())
        revised = revisions.revised(session, model, version)
    updates.learner.wake(model)
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


def _to_version(updates: Updates, model: str, version: int) -> RolledBack:
    if version == revisions.serving(updates.database, model):
        raise ConflictError(f"version {version} of model {model!r} serves already")
    updates.loaded.get(model, version)  # so that the change costs no query anything, or fails before it is made
    with updates.database.transaction() as session:
        registry.serve(session, model, version)
        revised = revisions.revised(session, model, version)
        complete = _is_reached(revised.revision, revisions.reachable(session, model, version))
    updates.loaded.adopt(model)
    updates.learner.wake(model)
    return RolledBack(**revised.model_dump(), undone=0, complete=complete)
