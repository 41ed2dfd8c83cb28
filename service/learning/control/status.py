"""Where the learning of a model stands, and how well the model predicts."""

from __future__ import annotations

import time

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.vocabulary import CODES, LEARNT
from service.journal import log, snapshots
from service.learning import owner
from service.learning.control import decisions, schema
from service.learning.control.inspection import figures
from service.learning.ingest.monitor import Window
from service.learning.learners import Learners
from service.storage.database import LearnerRow, StreamRow

MOST_GAPS = 20
"""Gaps of a stream that are listed."""


def learning(learners: Learners, model: str) -> schema.Learning:
    """Return how a model learns and where that stands; raise NotFoundError. Not for the event loop."""
    served = learners.loaded.get(model, None)
    version = served.version
    latest = learners.status(model, version)
    with learners.database.session() as session:
        start, events = log.start_of(session, model, version), log.newest(session, model)
        status = schema.LearningStatus(
            version=version,
            revision=events - start,
            published=served.revision,
            lag_events=max(events - start - served.revision, 0),
            events=events,
            novel_share=latest.novel_share,
            linearisation_error=None if latest.published is None else latest.published.linearisation,
            failure=latest.failure,
            held=owner.held(session, model),
            candidate=_candidate(session, model, version),
            streams=_streams(session, model),
            reachable=[list(each) for each in decisions.reachable(session, model, version)],
            snapshots=[
                schema.Snapshot(revision=row.number - start, created_at=row.created_at)
                for row in snapshots.of(session, model, version)
            ],
        )
        return schema.Learning(model=model, options=owner.options(session, model), status=status)


def quality(learners: Learners, model: str) -> schema.Quality:
    """Return how well a model predicts each row before it is learnt, over the windows of the settings. Raise
    NotFoundError. Not for the event loop."""
    served = learners.loaded.get(model, None)
    now = time.time()
    return schema.Quality(
        model=model,
        version=served.version,
        revision=served.revision,
        joint_names=list(served.model.joint_names),
        windows=[window(each, now) for each in learners.monitor(model).windows],
    )


def window(sums: Window, now: float) -> schema.QualityWindow:
    """Return the figures and counts of a window before a Unix time, s."""
    counts = sums.counts(now)
    accepted = counts.pop(CODES[LEARNT], 0)
    return schema.QualityWindow(
        **figures(sums.record(now)).model_dump(), seconds=sums.seconds, accepted=accepted, rejected=dict(counts)
    )


def _candidate(session: Session, model: str, serving: int) -> schema.Candidate | None:
    query = select(LearnerRow.version).where(
        LearnerRow.model == model, LearnerRow.role == "candidate", LearnerRow.version != serving
    )
    version = session.scalar(query.order_by(LearnerRow.version.desc()).limit(1))
    if version is None:
        return None
    return schema.Candidate(version=version, revision=decisions.current(session, model, version))


def _streams(session: Session, model: str) -> list[schema.Stream]:
    query = select(StreamRow).where(StreamRow.model == model).order_by(StreamRow.stream_id)
    return [
        schema.Stream(
            stream_id=row.stream_id,
            kind=row.kind,
            last=row.last,
            offset_s=row.offset,
            gaps=row.missing["ranges"][-MOST_GAPS:],
            missing=sum(last - first + 1 for first, last in row.missing["ranges"]),
            forgotten=row.forgotten,
        )
        for row in session.scalars(query)
    ]
