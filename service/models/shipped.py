"""The model that comes with LIPServe."""

from __future__ import annotations

import logging
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

import lipcore
from lipcore.files.persistence import read_manifest
from service.foundation.settings import shipped_models
from service.models import registry
from service.storage.database import Database, DeletedModelRow, ModelRow, VersionRow
from service.storage.files import Files, new_id

logger = logging.getLogger(__name__)

SHIPPED = "panda-sim"


def install_shipped(database: Database, files: Files) -> None:
    """Register the model that comes with LIPServe; after an upgrade that brings another one, as a new version.

    Do nothing if the user has trained or imported a version under that name, or has deleted the model or its newest
    version.
    """
    source = shipped_models() / SHIPPED
    with database.session() as session:
        if not _is_missing(session, source):
            return
    folder, version = new_id("mv"), None
    with files.new_version(folder) as target:
        manifest = lipcore.copy_model(source, target)
    with database.transaction() as session:
        if _is_missing(session, source):  # another service that starts at the same time may have registered it
            version = registry.publish(session, SHIPPED, folder, manifest, None)
    if version is None:
        files.delete_version(folder)
        return
    logger.info("registered the shipped model %s as version %d", SHIPPED, version)


def _is_missing(session: Session, source: Path) -> bool:
    """Return whether the shipped model must be registered."""
    query = select(VersionRow).where(VersionRow.model == SHIPPED).order_by(VersionRow.version.desc())
    known = list(session.scalars(query))
    row = session.scalar(select(ModelRow).where(ModelRow.name == SHIPPED))
    if row is None:
        return session.get(DeletedModelRow, SHIPPED) is None
    if not known:
        return True
    made_by_user = known[0].job is not None or "imported" in known[0].manifest["lineage"]
    if made_by_user or row.last_version > known[0].version:
        return False
    shipped = read_manifest(source)["tensors"]["sha256"]
    return all(each.manifest["tensors"]["sha256"] != shipped for each in known)
