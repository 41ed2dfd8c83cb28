"""Looking into the log: its batches, what became of their rows, and the rows themselves."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from lipcore.online.record import Record
from lipcore.vocabulary import CODES
from service.foundation.errors import NotFoundError, not_found
from service.foundation.fields import finite
from service.journal import log
from service.learning.control import schema
from service.learning.ingest.batches import state
from service.learning.learners import Learners
from service.learning.schema import ObservationResponse
from service.models import registry
from service.storage.database import EventRow
from service.web.pagination import Page

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
    if source is not None and log.is_forgotten(source, sequence):
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
