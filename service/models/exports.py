"""Exports of a model. Each export is a line of the audit log."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.export.origin import ModelOrigin
from lipcore.vocabulary import ExportFormat
from service.contract.learning import Export
from service.storage import audit
from service.storage.database import AuditRow, Database

MAX_LINES = 100
"""Number of newest exports that are searched for the last one of each format."""


def note_export(database: Database, origin: ModelOrigin, kind: ExportFormat) -> None:
    """Record an export."""
    with database.transaction() as session:
        after = {"format": kind, "revision": origin.revision}
        audit.note(session, origin.model, "version exported", origin.version, after=after)


def list_exports(session: Session, model: str, version: int, revision: int) -> list[Export]:
    """Return the last export of a model in each format, newest first. version, revision: the serving ones."""
    query = select(AuditRow).where(AuditRow.model == model, AuditRow.change == "version exported")
    last: dict[str, Export] = {}
    for row in session.scalars(query.order_by(AuditRow.seq.desc()).limit(MAX_LINES)):
        assert row.version is not None  # `note_export` writes both
        assert row.after is not None
        outdated = (row.version, row.after["revision"]) != (version, revision)
        made = Export(**row.after, version=row.version, at=row.at, outdated=outdated)
        last.setdefault(made.format, made)
    return list(last.values())
