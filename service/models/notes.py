"""The note and the tags that people give to a version."""

from __future__ import annotations

from typing import Any

from service.contract.models import Annotation, Version
from service.models import registry
from service.storage import audit
from service.storage.database import Database, VersionRow


def annotate(database: Database, model: str, version: int, annotation: Annotation) -> Version:
    """Set the given fields of a version's note and tags; return the version; raise NotFoundError."""
    with database.transaction() as session:
        row = session.get(VersionRow, (model, version))
        if row is None:
            raise registry.missing(session, model, version)
        before = _state(row)
        for name in annotation.model_fields_set:
            setattr(row, name, getattr(annotation, name))
        after = _state(row)
        if after != before:
            audit.note(session, model, "version annotated", version, before=before, after=after)
    return registry.show_version(database, model, version)


def _state(row: VersionRow) -> dict[str, Any]:
    return {"note": row.note, "tags": row.tags or []}
