"""Where the learning of a model stands."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.journal import log
from service.learning import learning
from service.learning.control import revisions
from service.learning.control.learning_schema import Candidate, Held, Learning, LearningStatus, Snapshot, Stream
from service.learning.updates import Status, Updates
from service.storage.database import LearnerRow, StreamRow

MOST_GAPS = 20
"""Gaps of a stream that are listed."""


def show(updates: Updates, model: str) -> Learning:
    """Return how a model learns and where that stands; raise NotFoundError. Not for the event loop."""
    served = updates.loaded.get(model, None)
    version = served.version
    said = updates.status(model, version)
    with updates.database.session() as session:
        start, events = log.start_of(session, model, version), log.newest(session, model)
        held = learning.held(session, model)
        status = LearningStatus(
            version=version,
            revision=events - start,
            published=served.revision,
            lag_events=max(events - start - served.revision, 0),
            events=events,
            novel_share=novel_share(said),
            linearisation_error=_linearisation(said),
            failure=None if said.failed is None else said.failed.error,
            held=None if held is None else Held(at=held["at"], evidence=held["evidence"]),
            candidate=_candidate(session, model, version),
            streams=_streams(session, model),
            reachable=[list(each) for each in revisions.reachable(session, model, version)],
            snapshots=[
                Snapshot(revision=row.number - start, created_at=row.created_at)
                for row in revisions.snapshots(session, model, version)
            ],
        )
        return Learning(model=model, options=learning.options(session, model), status=status)


def novel_share(said: Status) -> float | None:
    """Share of the latest samples beyond the basis of a version, None where the learner has not said."""
    published = said.published
    return None if published is None else published.novel_share


def _linearisation(said: Status) -> list[float] | None:
    published = said.published
    return None if published is None or published.linearisation is None else list(published.linearisation)


def _candidate(session: Session, model: str, serving: int) -> Candidate | None:
    query = select(LearnerRow.version).where(
        LearnerRow.model == model, LearnerRow.role == "candidate", LearnerRow.version != serving
    )
    version = session.scalar(query.order_by(LearnerRow.version.desc()).limit(1))
    if version is None:
        return None
    return Candidate(version=version, revision=revisions.current(session, model, version))


def _streams(session: Session, model: str) -> list[Stream]:
    query = select(StreamRow).where(StreamRow.model == model).order_by(StreamRow.stream_id)
    return [_stream(row) for row in session.scalars(query)]


def _stream(row: StreamRow) -> Stream:
    ranges: list[list[int]] = row.missing["ranges"]
    return Stream.model_validate(
        {
            "stream_id": row.stream_id,
            "kind": row.kind,
            "last": row.last,
            "offset_s": row.offset,
            "gaps": ranges[-MOST_GAPS:],
            "missing": sum(last - first + 1 for first, last in ranges),
            "forgotten": row.forgotten,
        }
    )
