"""The smallest uncertainty of a version that its latest errors allow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import func, select

from lipcore.data.samples import Array
from lipcore.online.record import Record, error_floor
from service.storage.database import Database, EventRow

WINDOW_S = 2.0
"""Length of the window before the newest batch from which batches count, s."""
MIN_ROWS = 200
"""Min rows that count: older batches are added until there are so many."""


def error_floor_of(database: Database, model: str, version: int, through: int, n_joints: int) -> Array:
    """Return the lower bound (n,) of the function variance, (N·m)², from the errors up to event `through`.

    The batches are those of the last `WINDOW_S` before the newest batch, and older ones until there are `MIN_ROWS`
    rows.

    Batches that were undone do not count, nor do those of an unconfirmed stream that did not fit from its first second.
    The same is true of batches that wait for a decision, or that arrived while learning was paused.
    """
    clock = func.coalesce(EventRow.clock, EventRow.received)
    query = select(clock, EventRow.record).where(
        EventRow.model == model,
        EventRow.number <= through,
        EventRow.kind == "batch",
        EventRow.version == version,
        EventRow.void.is_(False),
        *(func.coalesce(EventRow.report[why].as_boolean(), False).is_(False) for why in ("doubted", "aside")),
    )
    records, rows = list[dict[str, Any]](), 0
    newest: float | None = None
    with database.session() as session:
        latest = query.order_by(EventRow.number.desc()).limit(500)
        events = session.execute(latest.execution_options(yield_per=20))  # most calls need only a few
        for at, record in events:
            if record is None:
                continue
            newest = at if newest is None else newest
            if rows >= MIN_ROWS and at < newest - WINDOW_S:
                break
            records.append(record)
            rows += record["rows"]
        events.close()
    total = Record.empty(n_joints)
    if rows:  # only two figures, in one average, because this runs twice a second
        figures = np.array([[record["squared"], record["noise"]] for record in records])
        squared, noise = np.average(figures, axis=0, weights=[record["rows"] for record in records])
        total = replace(total, rows=rows, squared=squared, noise=noise)
    return error_floor(total)
