"""Keep the record of a stream in its row, instead of its last batch and events; add a clock to each model."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"

STREAMS, LEARNING, EVENTS = (
    sa.table("streams", *(sa.column(name) for name in ("model", "stream_id")), sa.column("record", sa.JSON)),
    sa.table("learning", sa.column("model"), *(sa.column(name, sa.JSON) for name in ("options", "payload"))),
    sa.table(
        "events",
        *(sa.column(name) for name in ("model", "stream_id", "number", "kind", "version", "received")),
        *(sa.column(name, sa.JSON) for name in ("report", "detail")),
    ),
)


def upgrade() -> None:
    """Add the records, made of what earlier releases have logged."""
    op.add_column("streams", sa.Column("record", sa.JSON(), nullable=True))
    op.add_column("events", sa.Column("clock", sa.Double(), nullable=True))
    op.add_column("learning", sa.Column("payload", sa.JSON(), nullable=True))
    connection = op.get_bind()
    declared = _declared(connection)
    for model, stream_id in connection.execute(sa.select(STREAMS.c.model, STREAMS.c.stream_id)).all():
        last = _newest(connection, EVENTS.c.model == model, EVENTS.c.kind == "batch", EVENTS.c.stream_id == stream_id)
        if last is None or not (last.report or {}).get("gate"):
            continue
        of_stream = STREAMS.c.model == model, STREAMS.c.stream_id == stream_id
        said = [declared[key] for key in ((model, stream_id), (model, None)) if key in declared]
        record = _record(last, said)
        connection.execute(sa.update(STREAMS).where(*of_stream).values(record=record))
    for (model, stream_id), payload in declared.items():
        if stream_id is not None:
            continue
        known = connection.execute(sa.update(LEARNING).where(LEARNING.c.model == model).values(payload=payload))
        if not known.rowcount:
            connection.execute(sa.insert(LEARNING).values(model=model, options={}, payload=payload))


def _record(last: Any, said: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the record of a stream from its last batch and the payloads declared for it or for all streams."""
    report, scale = last.report, last.report.get("scale")
    payload = max(said, key=lambda each: each["event"], default=None)
    if (watch := report.get("payload")) is not None and (payload is None or payload["event"] < last.number):
        event = 0 if payload is None else payload["event"]
        payload = {"event": event, "received": last.received, "watch": watch, "version": last.version, "body": None}
    return {
        "format": 1,
        "gate": report["gate"],
        "opening": report.get("opening"),
        "doubted": bool(report.get("doubted")),
        "scale": None if scale is None else {"state": scale, "version": last.version},
        "payload": payload,
        "leapt": False,
        "begun": 0,
    }


def _declared(connection: sa.Connection) -> dict[tuple[str, str | None], dict[str, Any]]:
    """Payloads that were declared last, by model and stream, None for all streams of a model."""
    query = sa.select(EVENTS).where(EVENTS.c.kind == "payload").order_by(EVENTS.c.number)
    return {
        (event.model, event.detail["stream_id"]): {
            "event": event.number,
            "received": event.received,
            "watch": event.detail.get("watch"),
            "version": event.version,
            "body": event.detail.get("body"),
        }
        for event in connection.execute(query)
    }


def _newest(connection: sa.Connection, *conditions: sa.ColumnElement[bool]) -> Any:
    return connection.execute(sa.select(EVENTS).where(*conditions).order_by(EVENTS.c.number.desc()).limit(1)).first()
