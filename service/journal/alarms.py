"""Alarms about a learning model, with their evidence, and the events of alarms that the webhook sends."""

from __future__ import annotations

import time
from typing import Any, Literal

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.contract.learning import AlarmKind
from service.foundation.settings import Settings
from service.storage.audit import oldest_kept
from service.storage.database import AlarmEventRow, AlarmRow, Database, now
from service.storage.files import new_id
from service.storage.rows import Page, read_page

EVENT_AGE_S = 86400.0
"""Age up to which an event is sent, s. Older events are dropped."""
AlarmChange = Literal["alarm.raised", "alarm.cleared"]


def raise_alarm(
    session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any], clears: bool = False
) -> AlarmRow:
    """Add an alarm and its event. Both are visible once the session commits.

    clears: whether it reports that the reason of an earlier alarm of this kind is gone.
    """
    row = AlarmRow(model=model, kind=kind, at=now(), message=message, evidence=evidence)
    session.add(row)
    session.flush()
    add_event(session, "alarm.cleared" if clears else "alarm.raised", model, kind, message, evidence)
    return row


def add_event(
    session: Session, change: AlarmChange, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]
) -> None:
    """Store an event for the webhook, and delete events that are too old to be sent."""
    moment = time.time()
    session.execute(delete(AlarmEventRow).where(AlarmEventRow.at < moment - 2 * EVENT_AGE_S))  # without a webhook
    alarm = {"model": model, "kind": kind, "at": now(), "message": message, "evidence": evidence}
    body = {"id": new_id("evt"), "type": change, **alarm}
    session.add(AlarmEventRow(at=moment, body=body, attempts=0, due=moment))


def page(session: Session, model: str, part: Page) -> tuple[list[AlarmRow], str | None]:
    """Return the alarms of a page, read_page first, and the cursor after the page."""
    return read_page(session, AlarmRow, part, AlarmRow.model == model)


def clean(database: Database, settings: Settings) -> int:
    """Delete the alarms older than the lines of the audit log that are kept; return their number."""
    too_old = AlarmRow.at < oldest_kept(settings)
    with database.session() as session:  # a transaction would block other writers
        if session.scalar(select(AlarmRow.seq).where(too_old).limit(1)) is None:
            return 0
    with database.transaction() as session:
        return len(session.execute(delete(AlarmRow).where(too_old).returning(AlarmRow.seq)).all())
