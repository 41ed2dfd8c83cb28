"""The least uncertainty of a version: what its latest errors prove."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import func, select

from lipcore.data.samples import Array
from lipcore.online.record import Record, error_floor
from service.storage.database import Database, EventRow

SECONDS = 2.0
FEWEST_ROWS = 200


def error_floor_of(database: Database, model: str, version: int, through: int, n_joints: int) -> Array:
    """Return the function variance (N·m)², (n,), that a version's errors up to event `through` prove: its std is no
    lower.

    The batches are those of the last SECONDS before the newest one came, and more until there are FEWEST_ROWS rows. Not
    those that were undone, of a stream that did not fit from its first second on and that nobody has confirmed, that
    wait for their owner's decision, or that came while learning was paused.
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
        events = session.execute(latest.execution_options(yield_per=20))  # few are needed as a rule
        for at, record in events:
            if record is None:
                continue
            newest = at if newest is None else newest
            if rows >= FEWEST_ROWS and at < newest - SECONDS:
                break
            records.append(record)
            rows += record["rows"]
        events.close()
    total = Record.empty(n_joints)
    if rows:  # all of them at once, and only what the floor is made of: it is asked for twice a second
        figures = np.array([[record["squared"], record["noise"]] for record in records])
        squared, noise = np.average(figures, axis=0, weights=[record["rows"] for record in records])
        total = replace(total, rows=rows, squared=squared, noise=noise)
    return error_floor(total)
