"""The audit log: who changed which model, when, by which route or job, and the values before and after.

A line is written in the transaction of its change, so that neither exists without the other. It is never changed. It is
deleted when it is older than `LIPSERVE_AUDIT_RETENTION_S`.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.contract.audit import Change
from service.foundation.settings import Settings
from service.storage.database import ApiKeyRow, AuditRow, Database, JobRow, now
from service.storage.rows import Page, read_page
from service.telemetry.logs import KEY_ID, job_id, request_id, request_scope

SERVICE = "service"
"""Replaces the route if no request made the change: a version shipped with LIPServe, or an automatic promotion."""


def note(
    session: Session,
    model: str,
    change: Change,
    version: int | None = None,
    alias: str | None = None,
    before: Any = None,
    after: Any = None,
) -> None:
    """Add a line to the transaction of a change. before, after: JSON values.

    The author comes from the current request or job.
    """
    key, what, request = None, SERVICE, request_id.get()
    scope, job = request_scope.get(), job_id.get()
    if job is not None:
        row = session.scalar(select(JobRow).where(JobRow.id == job))
        what = f"job {job}"
        key, request = (None, None) if row is None else (row.key, row.request_id)
    elif scope is not None:
        route = scope.get("route") or scope.get("endpoint")  # Starlette names no route of a WebSocket
        path = getattr(route, "path", scope["path"])
        key, what = scope.get(KEY_ID), f"{scope.get('method', 'WEBSOCKET')} {path}"
    name = None if key is None else session.scalar(select(ApiKeyRow.name).where(ApiKeyRow.id == key))
    details = {"version": version, "alias": alias, "before": before, "after": after}
    who = {"key": key, "key_name": name, "what": what, "request_id": request}
    session.add(AuditRow(at=now(), model=model, change=change, **who, **details))


def page(
    database: Database,
    part: Page,
    model: str | None = None,
    key: str | None = None,
    change: str | None = None,
    since: datetime | None = None,
    until: datetime | None = None,
) -> tuple[list[AuditRow], str | None]:
    """Return the lines of a page, newest first, and the next cursor.

    Lines are filtered by model, key and kind of change if given, from `since` and before `until`.
    """
    given = ((AuditRow.model, model), (AuditRow.key, key), (AuditRow.change, change))
    conditions = [column == value for column, value in given if value is not None]
    if since is not None:
        conditions.append(AuditRow.at >= _text(since))
    if until is not None:
        conditions.append(AuditRow.at < _text(until))
    with database.session() as session:
        return read_page(session, AuditRow, part, *conditions)


def _text(moment: datetime) -> str:
    """Return a time in the format of the lines; their text order is the order of time."""
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")


def oldest_kept(settings: Settings) -> str:
    """Return the time of the oldest lines that are kept, ISO 8601 in UTC."""
    return _text(datetime.now(UTC) - timedelta(seconds=settings.audit_retention_s))


def clean(database: Database, settings: Settings) -> int:
    """Delete lines older than the retention setting; return their number."""
    too_old = AuditRow.at < oldest_kept(settings)
    with database.session() as session:
        if session.scalar(select(AuditRow.seq).where(too_old).limit(1)) is None:
            return 0
    with database.transaction() as session:
        gone = session.execute(delete(AuditRow).where(too_old).returning(AuditRow.seq))
        return len(gone.all())
