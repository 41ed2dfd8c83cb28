"""What of a model's log, and of the data its version was trained on, still speaks of the robot as it is."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.journal import log
from service.storage.database import DatasetRow, EventRow

MEMORY = 5.0
"""Forgetting times after which a sample is left out: it would count less than one per cent."""


@dataclass(frozen=True)
class Scope:
    """What a refresh learns from: rows of the log up to event `through` with an event time of at least `since`, s.

    newest: the latest event time of the log so far, s, None without rows; forgetting_s: time constant of forgetting;
    changed: event time of the last change of the robot, before which all data are of another robot.
    """

    through: int
    since: float
    newest: float | None
    forgetting_s: float | None
    changed: float | None

    def left_out(self, recorded: DatasetRow) -> str | None:
        """Why a data set is not learnt from; None where it is. Its age counts from its upload."""
        if self.changed is not None:
            return "the robot has changed since"
        if datetime.fromisoformat(recorded.created_at).timestamp() < self.since:
            return f"it is older than {MEMORY:g} forgetting times"
        return None


def find(session: Session, model: str, through: int) -> Scope:
    """Scope of the log up to an event, as it stands now."""
    live = (EventRow.model == model, EventRow.number <= through, EventRow.void.is_(False))
    newest = session.scalar(select(func.max(EventRow.last)).where(*live, EventRow.learnt > 0))
    details = session.scalars(select(EventRow.detail).where(*live, EventRow.kind == "change"))
    changed = max((float((detail or {})["t"]) for detail in details), default=None)
    forgetting_s = log.forgetting(session, model, through)
    since = -math.inf if changed is None else changed
    if forgetting_s is not None and newest is not None:
        since = max(since, newest - MEMORY * forgetting_s)
    return Scope(through, since, newest, forgetting_s, changed)


def rows(session: Session, model: str, scope: Scope) -> int:
    """How many rows of the log are in scope, or up to one batch more: only whole batches are counted."""
    live = (EventRow.model == model, EventRow.number <= scope.through, EventRow.void.is_(False))
    return session.scalar(select(func.sum(EventRow.learnt)).where(*live, EventRow.last >= scope.since)) or 0


def split(session: Session, scope: Scope, lineage: dict[str, Any]) -> tuple[list[DatasetRow], list[dict[str, str]]]:
    """Data sets of a version's lineage that a refresh learns from, in order, and why it leaves out the others."""
    named = [item["id"] for item in lineage.get("datasets", [])]
    found = {row.id: row for row in _datasets(session, named)}
    kept, left_out = [], []
    for name in named:
        why = scope.left_out(found[name]) if name in found else "it has been deleted"
        if why is None:
            kept.append(found[name])
        else:
            left_out.append({"id": name, "reason": why})
    return kept, left_out


def taken_back(session: Session, model: str, through: int, after: int) -> bool:
    """Whether an event above number `after` has unlearnt or rolled back something up to event `through`."""
    later = (EventRow.model == model, EventRow.number > after)
    undone = select(EventRow.kind, EventRow.detail).where(*later, EventRow.kind.in_(("unlearn", "rollback")))
    return any(
        detail["event"] <= through if kind == "unlearn" else detail["to"] < through
        for kind, detail in session.execute(undone)
    )


def _datasets(session: Session, names: Collection[str]) -> list[DatasetRow]:
    return list(session.scalars(select(DatasetRow).where(DatasetRow.id.in_(names))))
