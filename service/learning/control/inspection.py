"""Looking into the log: its batches, what became of their rows, and the rows themselves."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from math import isfinite
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.record import Record
from lipcore.vocabulary import CODES
from service.foundation.errors import NotFoundError, not_found
from service.journal import log
from service.journal.log import EventKind, decode
from service.learning.control.schema import (
    Figures,
    Observation,
    ObservationDetail,
    ObservationPage,
    ObservationRows,
    Replay,
)
from service.learning.ingest.batches import state
from service.learning.learners import Learners
from service.learning.schema import ObservationResponse
from service.models import registry
from service.storage.database import EventRow
from service.web.rows import Page

BATCHES: tuple[EventKind] = ("batch",)
FIGURES = ("nmse", "rmse", "coverage", "nlpd")


def page(learners: Learners, model: str, part: Page, stream_id: str | None, rejected: bool) -> ObservationPage:
    """List the batches of a model, newest first; raise NotFoundError where there is no such model."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        events, following = log.page(session, model, part, stream_id, rejected, BATCHES)
        return ObservationPage(
            items=[Observation(**_outline(session, event)) for event in events], next_cursor=following
        )


def show(learners: Learners, model: str, stream_id: str, sequence: int, rows: bool) -> ObservationDetail:
    """Return a batch with all that is known of it; raise NotFoundError."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        event = find(session, model, stream_id, sequence)
        return ObservationDetail(
            **_outline(session, event),
            report=None if event.report is None else _acknowledged(event.report),
            figures=None if event.record is None else figures(Record.from_json(event.record)),
            replays=[_replay(session, event, each) for each in replays(session, event)],
            observed=_rows(rows_of(event)) if rows else None,
        )


def figures(record: Record) -> Figures:
    """Return the figures of a record, per joint."""
    metrics = record.metrics()
    return Figures(rows=record.rows, **{name: metrics[name] for name in FIGURES})


def find(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch of a sequence, its own or that of one of its frames; raise NotFoundError."""
    event = log.covering(session, model, stream_id, sequence)
    if event is not None:
        return event
    source = log.stream(session, model, stream_id)
    if source is not None and log.is_forgotten(source, sequence):
        raise NotFoundError(f"batch {sequence} of stream {stream_id!r} is no longer kept, if it has come")
    raise not_found("batch", f"{sequence} of stream {stream_id}")


def rows_of(event: EventRow) -> Rows:
    """Return the rows of a batch or a replay, which are read only now."""
    assert event.payload is not None  # both have one for as long as they are in the log
    return decode(event.payload)


def replays(session: Session, batch: EventRow) -> Sequence[EventRow]:
    """Events that have learnt rows of a batch later, in order, also those that were undone since."""
    query = select(EventRow).where(
        EventRow.model == batch.model,
        EventRow.number > batch.number,
        EventRow.kind == "replay",
        EventRow.detail["event"].as_integer() == batch.number,
    )
    return session.scalars(query.order_by(EventRow.number)).all()


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


def _acknowledged(report: dict[str, Any]) -> dict[str, Any]:
    """The part of a report that acknowledged the batch; the rest is for judging what follows."""
    return {name: value for name, value in report.items() if name in ObservationResponse.model_fields}


def _replay(session: Session, batch: EventRow, event: EventRow) -> Replay:
    """A replay is unlearnt with its batch; undone in another way it is by a rollback."""
    undone = state(session, batch) if batch.void else "rolled_back"
    return Replay(
        event=event.number,
        replayed_at=_moment(event.received),
        state=undone if event.void else "learnt",
        codes=(event.detail or {})["codes"],
        rows=event.rows,
    )


def _rows(rows: Rows) -> ObservationRows:
    return ObservationRows(
        time=_finite(rows.time),
        q=[_finite(row) for row in rows.q],
        dq=[_finite(row) for row in rows.dq],
        ddq=[_finite(row) for row in rows.ddq],
        tau=[_finite(row) for row in rows.tau],
        code=[CODES[code] for code in rows.code],
    )


def _finite(values: Array) -> list[float | None]:
    return [value if isfinite(value) else None for value in values.tolist()]


def _moment(seconds: float) -> str:
    """Unix seconds as every other answer has times."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
