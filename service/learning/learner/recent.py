"""How far off a version has been lately, which its stated uncertainty must not fall below."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online.record import Record, error_floor
from service.storage.database import Database, EventRow

SECONDS = 2.0
FEWEST_ROWS = 200
MOST_EVENTS = 500
"""Batches that are looked at, at most."""


def floor(database: Database, model: str, version: int, through: int, n_joints: int) -> Array:
    """Function variance (N·m)², (n,), that the errors of a version prove in the last batches up to event `through`.

    Those of the last SECONDS before the newest of them was received, and before that until there are FEWEST_ROWS rows.
    Like what is learnt it is a function of the log up to that event, whatever was taken back since.
    """
    of_version = (EventRow.kind == "batch", EventRow.version == version)
    upto = (EventRow.model == model, EventRow.number <= through)
    query = select(EventRow.received, EventRow.record).where(*upto, *of_version).order_by(EventRow.number.desc())
    with database.session() as session:
        counts = EventRow.void.is_(False) | EventRow.number.in_(_undone_later(session, model, through))
        rows = session.execute(query.where(counts).limit(MOST_EVENTS))
        found = [(received, record) for received, record in rows if record is not None]
    total = Record.empty(n_joints)
    for received, record in found:
        if total.rows >= FEWEST_ROWS and received < found[0][0] - SECONDS:
            break
        total += Record.from_json(record)
    return error_floor(total)


def _undone_later(session: Session, model: str, through: int) -> list[int]:
    """Batches up to event `through` that count there and were taken back since; the newest ones, and seldom any."""
    kinds = EventRow.kind.in_(("unlearn", "rollback"))
    query = select(EventRow.number, EventRow.kind, EventRow.detail).where(EventRow.model == model, kinds)
    later = session.execute(query.where(EventRow.number > through)).all()
    if not later:
        return []
    lowest = min(each.detail["to"] + 1 if each.kind == "rollback" else each.detail["event"] for each in later)
    before = session.execute(query.where(EventRow.number > lowest, EventRow.number <= through)).all()
    undone = {each.detail["event"] for each in before if each.kind == "unlearn"}
    spans = [range(each.detail["to"] + 1, each.number) for each in before if each.kind == "rollback"]
    void = select(EventRow.number).where(
        EventRow.model == model, EventRow.kind == "batch", EventRow.void, EventRow.number >= lowest
    )
    numbers = session.scalars(void.where(EventRow.number <= through).order_by(EventRow.number.desc()))
    counted = [each for each in numbers if each not in undone and not any(each in span for span in spans)]
    return counted[:MOST_EVENTS]
