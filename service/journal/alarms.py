"""Alarms about a learning model, with their evidence."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from service.contract.learning import AlarmKind
from service.storage.database import AlarmRow, now
from service.storage.rows import Page, read_page


def raise_alarm(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> AlarmRow:
    """Add an alarm. It is visible once the session commits."""
    row = AlarmRow(model=model, kind=kind, at=now(), message=message, evidence=evidence)
    session.add(row)
    session.flush()
    return row


def page(session: Session, model: str, part: Page) -> tuple[list[AlarmRow], str | None]:
    """Return the alarms of a page, read_page first, and the cursor after the page."""
    return read_page(session, AlarmRow, part, AlarmRow.model == model)
