"""Where the learning of a model stands, how well the model predicts, and what its log has of batches and their rows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from lipcore.online.record import Record
from lipcore.online.window import Window
from lipcore.vocabulary import CODES
from service.contract import learning as schema
from service.contract.observations import ObservationResponse
from service.foundation.errors import NotFoundError, not_found
from service.foundation.fields import finite
from service.journal import log, snapshots
from service.journal.arrivals import is_forgotten
from service.learning import owner
from service.learning.ingest.observations import state
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import EventRow, StreamRow
from service.storage.rows import Page

Range = tuple[int, int]
MOST_GAPS = 20
"""Gaps of a stream that are listed."""


def learning(learners: Learners, model: str) -> schema.Learning:
    """Return how a model learns and where that stands; raise NotFoundError. Not for the event loop."""
    served = learners.loaded.get(model, None)
    version = served.version
    latest, lag = learners.status(model, version), learners.lag(served)
    with learners.database.session() as session:
        start, events = log.start_of(session, model, version), log.newest(session, model)
        status = schema.LearningStatus(
            version=version,
            revision=events - start,
            published=served.revision,
            lag_events=max(events - start - served.revision, 0),
            lag_rows=lag.rows,
            lag_s=lag.seconds,
            events=events,
            novel_share=latest.novel_share,
            linearisation_error=None if latest.published is None else latest.published.linearisation,
            failure=latest.failure,
            held=owner.held(session, model),
            streams=_streams(session, model),
            reachable=[list(each) for each in reachable(session, model, version)],
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
        scale=served.scales.asked,
    )


def window(sums: Window, now: float) -> schema.QualityWindow:
    """Return the figures and counts of a window before a Unix time, s."""
    counts = sums.counts(now)
    accepted = counts.pop("learnt", 0)
    return schema.QualityWindow(
        **figures(sums.record(now)).model_dump(),
        seconds=sums.seconds,
        accepted=accepted,
        rejected=dict(counts),
        coverage_answered=sums.held(now).coverage(),
    )


def _streams(session: Session, model: str) -> list[schema.Stream]:
    query = select(StreamRow).where(StreamRow.model == model).order_by(StreamRow.stream_id)
    return [
        schema.Stream(
            stream_id=row.stream_id,
            kind=row.kind,
            last=row.last,
            last_at=None if row.received is None else _moment(row.received),
            offset_s=row.offset,
            gaps=row.missing["ranges"][-MOST_GAPS:],
            missing=sum(last - first + 1 for first, last in row.missing["ranges"]),
            forgotten=row.forgotten,
        )
        for row in session.scalars(query)
    ]


FIGURES = ("nmse", "rmse", "coverage", "nlpd")
ACKNOWLEDGED = ObservationResponse.model_fields
"""The part of a report that acknowledged a batch; the rest is for judging what follows."""


def page(learners: Learners, model: str, part: Page, stream_id: str | None, rejected: bool) -> schema.ObservationPage:
    """List the batches of a model, newest first; raise NotFoundError where there is no such model."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        events, following = log.page(session, model, part, stream_id, rejected)
        return schema.ObservationPage(
            items=[schema.Observation(**_outline(session, event)) for event in events], next_cursor=following
        )


def show(learners: Learners, model: str, stream_id: str, sequence: int, rows: bool) -> schema.ObservationDetail:
    """Return a batch with all that is known of it; raise NotFoundError."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        event = find(session, model, stream_id, sequence)
        return schema.ObservationDetail(
            **_outline(session, event),
            report=None if event.report is None else {k: v for k, v in event.report.items() if k in ACKNOWLEDGED},
            figures=None if event.record is None else figures(Record.from_json(event.record)),
            replays=[_replay(session, event, each) for each in log.about(session, event, "replay")],
            observed=_rows(log.rows_of(event)) if rows else None,
        )


def figures(record: Record) -> schema.Figures:
    """Return the figures of a record, per joint."""
    metrics = record.metrics()
    return schema.Figures(rows=record.rows, **{name: metrics[name] for name in FIGURES})


def find(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch of a sequence, its own or that of one of its frames; raise NotFoundError."""
    event = log.covering(session, model, stream_id, sequence)
    if event is not None:
        return event
    source = log.stream(session, model, stream_id)
    if source is not None and is_forgotten(source, sequence):
        raise NotFoundError(f"batch {sequence} of stream {stream_id!r} is no longer kept, if it has come")
    raise not_found("batch", f"{sequence} of stream {stream_id}")


def _outline(session: Session, event: EventRow) -> dict[str, Any]:
    return {
        "stream_id": event.stream_id,
        "sequence": event.sequence,
        "last_sequence": event.last_sequence,
        "event": event.number,
        "state": state(session, event),
        "received_at": _moment(event.received),
        "first_at": None if event.first is None else _moment(event.first),
        "last_at": None if event.last is None else _moment(event.last),
        "version": event.version,
        "revision": event.revision,
        "rows": (event.report or {}).get("rows", event.rows),
        "accepted": event.learnt,
        "rejected": (event.report or {}).get("rejected", {}),
    }


def _replay(session: Session, batch: EventRow, event: EventRow) -> schema.Replay:
    """A replay is unlearnt with its batch; undone in another way it is by a rollback."""
    undone = state(session, batch) if batch.void else "rolled_back"
    return schema.Replay(
        event=event.number,
        replayed_at=_moment(event.received),
        state=undone if event.void else "learnt",
        codes=(event.detail or {})["codes"],
        rows=event.rows,
    )


def _rows(rows: Rows) -> schema.ObservationRows:
    vectors = {name: [finite(row) for row in getattr(rows, name)] for name in ("q", "dq", "ddq", "tau")}
    return schema.ObservationRows(time=finite(rows.time), **vectors, code=[CODES[code] for code in rows.code])


def _moment(seconds: float) -> str:
    """Unix seconds as every other answer has times."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def current(session: Session, model: str, version: int) -> int:
    """Return the revision of a version once all of the log is learnt."""
    return log.newest(session, model) - log.start_of(session, model, version)


def reachable(session: Session, model: str, version: int) -> list[Range]:
    """Return the ranges [first, last] of revisions whose state can be made again, rising.

    That takes the version as trained, or a snapshot, and all events from there; and no rollback may have gone back
    behind it since: the events that a rollback has undone teach nothing any more, so that their states are gone.
    """
    start, newest = log.start_of(session, model, version), log.newest(session, model)
    bases = sorted({start, *(row.number for row in snapshots.of(session, model, version) if row.number > start)})
    ranges: list[Range] = []
    for base, following in zip(bases, [*bases[1:], newest + 1], strict=True):
        last = following - 1
        ranges.append((base, last if log.is_complete(session, model, base, last) else base))
    rollbacks = select(EventRow.number, EventRow.detail).where(EventRow.model == model, EventRow.kind == "rollback")
    for number, detail in session.execute(rollbacks):
        ranges = [part for each in ranges for part in _without(each, detail["to"] + 1, number - 1)]
    return _joined([(first - start, last - start) for first, last in ranges])


def is_reached(revision: int, ranges: list[Range]) -> bool:
    """Whether one of the ranges has a revision."""
    return any(first <= revision <= last for first, last in ranges)


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
