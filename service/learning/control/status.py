"""The status of learning, the prediction quality of a model, and the batches of its log."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from lipcore.online.record import Record
from lipcore.online.window import Window
from lipcore.vocabulary import CODES
from service.contract import learning as schema
from service.contract.observations import ObservationResponse
from service.contract.verdict import Verdict
from service.foundation.errors import NotFoundError, not_found
from service.foundation.fields import finite
from service.journal import log, snapshots
from service.journal.arrivals import is_forgotten
from service.learning import owner
from service.learning.ingest.observations import read_state
from service.learning.learners import Learners
from service.models import registry, verdicts
from service.models.exports import list_exports
from service.models.served import ServedModel
from service.storage.database import EventRow, StreamRow, iso_time
from service.storage.rows import Page

Range = tuple[int, int]
MAX_GAPS = 20
"""Gaps of a stream that are listed."""


def read_learning(learners: Learners, model: str) -> schema.Learning:
    """Return how a model learns and its status; raise NotFoundError. Blocking: use it in a thread."""
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
            held=owner.read_pause(session, model),
            streams=_streams(session, model),
            reachable=[list(each) for each in list_reachable(session, model, version)],
            snapshots=[
                schema.Snapshot(revision=row.number - start, created_at=row.created_at)
                for row in snapshots.list_snapshots(session, model, version)
            ],
            exports=list_exports(session, model, version, events - start),
        )
        return schema.Learning(model=model, options=owner.read_options(session, model), status=status)


def read_quality(learners: Learners, model: str) -> schema.Quality:
    """Return how well a model predicts each row before it is learnt, for each window of `WINDOWS_S`.

    Raise NotFoundError. Blocking: use it in a thread.
    """
    served = learners.loaded.get(model, None)
    now = time.time()
    return schema.Quality(
        model=model,
        version=served.version,
        revision=served.revision,
        joint_names=list(served.model.joint_names),
        windows=[summarise_window(each, now) for each in learners.monitor(model).windows],
        scale=served.scales.default_factors,
        verdict=judge_lately(learners, served, registry.find(learners.database, model, served.version).manifest, now),
    )


def judge_lately(learners: Learners, served: ServedModel, manifest: Mapping[str, Any], now: float) -> Verdict:
    """Return the verdict on the responses of a serving version, by the shortest window before a Unix time, s."""
    options = registry.verdict_options(learners.database, [served.name])[served.name]
    window = min(learners.monitor(served.name).windows, key=lambda each: each.seconds)
    return verdicts.of_window(window, now, manifest, options)


def summarise_window(sums: Window, now: float) -> schema.QualityWindow:
    """Return the figures and counts of a window before a Unix time, s."""
    counts = sums.counts(now)
    accepted = counts.pop("learnt", 0)
    return schema.QualityWindow(
        **summarise_record(sums.record(now)).model_dump(),
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
            last_at=None if row.received is None else iso_time(row.received),
            offset_s=row.offset,
            gaps=row.missing["ranges"][-MAX_GAPS:],
            missing=sum(last - first + 1 for first, last in row.missing["ranges"]),
            forgotten=row.forgotten,
        )
        for row in session.scalars(query)
    ]


FIGURE_NAMES = ("nmse", "rmse", "coverage", "nlpd")
ACK_FIELDS = ObservationResponse.model_fields
"""Fields of a report that acknowledged the batch. The others serve the judgement of later batches."""


def list_batches(
    learners: Learners, model: str, part: Page, stream_id: str | None, rejected: bool
) -> schema.ObservationPage:
    """Return the batches of a model, newest first; raise NotFoundError for an unknown model."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        events, following = log.page(session, model, part, stream_id, rejected)
        return schema.ObservationPage(
            items=[schema.Observation(**_outline(session, event)) for event in events], next_cursor=following
        )


def read_batch(learners: Learners, model: str, stream_id: str, sequence: int, rows: bool) -> schema.ObservationDetail:
    """Return a batch with its report, figures and replays; raise NotFoundError."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        event = find_batch(session, model, stream_id, sequence)
        return schema.ObservationDetail(
            **_outline(session, event),
            report=None if event.report is None else {k: v for k, v in event.report.items() if k in ACK_FIELDS},
            figures=None if event.record is None else summarise_record(Record.from_json(event.record)),
            replays=[_replay(session, event, each) for each in log.find_related(session, event, "replay")],
            observed=_rows(log.rows_of(event)) if rows else None,
        )


def summarise_record(record: Record) -> schema.Figures:
    """Return the figures of a record for each joint."""
    metrics = record.metrics()
    return schema.Figures(rows=record.rows, **{name: metrics[name] for name in FIGURE_NAMES})


def find_batch(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch that contains a sequence, its own or that of one of its frames; raise NotFoundError."""
    event = log.find_covering_batch(session, model, stream_id, sequence)
    if event is not None:
        return event
    source = log.stream(session, model, stream_id)
    if source is not None and is_forgotten(source, sequence):
        raise NotFoundError(f"batch {sequence} of stream {stream_id!r} is not in the log: it was deleted or never sent")
    raise not_found("batch", f"{sequence} of stream {stream_id}")


def _outline(session: Session, event: EventRow) -> dict[str, Any]:
    return {
        "stream_id": event.stream_id,
        "sequence": event.sequence,
        "last_sequence": event.last_sequence,
        "event": event.number,
        "state": read_state(session, event),
        "received_at": iso_time(event.received),
        "first_at": None if event.first is None else iso_time(event.first),
        "last_at": None if event.last is None else iso_time(event.last),
        "version": event.version,
        "revision": event.revision,
        "rows": (event.report or {}).get("rows", event.rows),
        "accepted": event.learnt,
        "rejected": (event.report or {}).get("rejected", {}),
    }


def _replay(session: Session, batch: EventRow, event: EventRow) -> schema.Replay:
    """Return a replay. It is unlearnt with its batch; if it was undone alone, a rollback did it."""
    undone = read_state(session, batch) if batch.void else "rolled_back"
    return schema.Replay(
        event=event.number,
        replayed_at=iso_time(event.received),
        state=undone if event.void else "learnt",
        codes=(event.detail or {})["codes"],
        rows=event.rows,
    )


def _rows(rows: Rows) -> schema.ObservationRows:
    vectors = {name: [finite(row) for row in getattr(rows, name)] for name in ("q", "dq", "ddq", "tau")}
    return schema.ObservationRows(time=finite(rows.time), **vectors, code=[CODES[code] for code in rows.code])


def read_newest_revision(session: Session, model: str, version: int) -> int:
    """Return the revision of a version after the whole log is learnt."""
    return log.newest(session, model) - log.start_of(session, model, version)


def list_reachable(session: Session, model: str, version: int) -> list[Range]:
    """Return the ranges [first, last] of revisions that can be reconstructed, in rising order.

    A state needs the version as trained or a snapshot, and all events since. Events that a rollback has undone are not
    learnt again, so their states are lost.
    """
    start, newest = log.start_of(session, model, version), log.newest(session, model)
    bases = sorted(
        {start, *(row.number for row in snapshots.list_snapshots(session, model, version) if row.number > start)}
    )
    ranges: list[Range] = []
    for base, following in zip(bases, [*bases[1:], newest + 1], strict=True):
        last = following - 1
        ranges.append((base, last if log.is_complete(session, model, base, last) else base))
    rollbacks = select(EventRow.number, EventRow.detail).where(EventRow.model == model, EventRow.kind == "rollback")
    for number, detail in session.execute(rollbacks):
        ranges = [part for each in ranges for part in _without(each, detail["to"] + 1, number - 1)]
    return _joined([(first - start, last - start) for first, last in ranges])


def is_reachable(revision: int, ranges: list[Range]) -> bool:
    """Return whether a revision lies in one of the ranges."""
    return any(first <= revision <= last for first, last in ranges)


def _without(span: Range, first: int, last: int) -> Iterator[Range]:
    """Yield the parts of a range outside first to last."""
    for a, b in ((span[0], min(span[1], first - 1)), (max(span[0], last + 1), span[1])):
        if a <= b:
            yield a, b


def _joined(ranges: list[Range]) -> list[Range]:
    """Return the same numbers in as few ranges as possible."""
    joined: list[Range] = []
    for first, last in sorted(ranges):
        if joined and first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return joined
