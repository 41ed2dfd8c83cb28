"""What interrupted writes have left is deleted when a service starts."""

from __future__ import annotations

import logging
import threading

from sqlalchemy import select

from service.storage.database import Database, DatasetRow, SnapshotRow, VersionRow
from service.storage.files.store import Files

logger = logging.getLogger(__name__)


def start(database: Database, files: Files) -> None:
    """Delete files that no row names: before the service starts, or beside it where a store is shared.

    To list a large store takes minutes, and who starts then may be needed.
    """
    if cleared := files.clear():
        logger.warning("removed %d unfinished uploads of an earlier run", cleared)
    if files.shared:
        threading.Thread(target=_beside, args=(database, files), name="sweep", daemon=True).start()
    else:
        sweep(database, files)


def sweep(database: Database, files: Files) -> int:
    """Delete files that no row names; return how many."""
    with database.session() as session:
        datasets = set(session.scalars(select(DatasetRow.id)))
        versions = set(session.scalars(select(VersionRow.folder)))
        snapshots = set(session.scalars(select(SnapshotRow.id)))
    swept = files.sweep(datasets, versions, snapshots)
    if swept:
        logger.warning("removed %d unfinished files of an earlier run", swept)
    return swept


def _beside(database: Database, files: Files) -> None:
    try:
        sweep(database, files)
    except Exception as error:  # it will be done at another start
        logger.warning("what interrupted writes have left is not swept now: %s", error)
