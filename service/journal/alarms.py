"""What the owner of a learning model should know, with the evidence."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from service.contract.learning import AlarmKind
from service.storage.database import AlarmRow, now
from service.storage.rows import Page, newest


def raise_alarm(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> AlarmRow:
    """Add an alarm; it is visible once the session commits."""
    row = AlarmRow(model=model, kind=kind, at=now(), message=message, evidence=evidence)
    session.add(row)
    session.flush()
    return row


def page(session: Session, model: str, part: Page) -> tuple[list[AlarmRow], str | None]:
    """Alarms of a page, newest first, and the cursor after it."""
    return newest(session, AlarmRow, part, AlarmRow.model == model)
