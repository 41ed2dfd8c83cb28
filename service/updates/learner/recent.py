"""How far off a version has been lately, which its stated uncertainty must not fall below."""

from __future__ import annotations

from sqlalchemy import select

from lipcore.online.floor import error_floor
from lipcore.online.record import Record
from lipcore.samples import Array
from service.database import Database, EventRow

SECONDS = 2.0
FEWEST_ROWS = 200
MOST_EVENTS = 500
"""Batches that are looked at, at most."""


def floor(database: Database, model: str, version: int, through: int, n_joints: int) -> Array:
    """Function variance (N·m)², (n,), that the errors of a version prove in the last batches up to event `through`.

    Those of the last SECONDS before the newest of them was received, and before that until there are FEWEST_ROWS rows.
    """
    query = (
        select(EventRow.received, EventRow.record)
        .where(
            EventRow.model == model,
            EventRow.number <= through,
            EventRow.kind == "batch",
            EventRow.version == version,
            EventRow.void.is_(False),
        )
        .order_by(EventRow.number.desc())
        .limit(MOST_EVENTS)
    )
    with database.session() as session:
        found = [(received, record) for received, record in session.execute(query) if record is not None]
    total = Record.empty(n_joints)
    for received, record in found:
        if total.rows >= FEWEST_ROWS and received < found[0][0] - SECONDS:
            break
        total += Record.from_json(record)
    return error_floor(total)
