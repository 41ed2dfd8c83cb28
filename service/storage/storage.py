"""What a service keeps things in: a database, a store of files, a disk that has to have room; and how these are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends
from sqlalchemy import text

from service.foundation.fields import of_app
from service.foundation.settings import Settings
from service.foundation.states import PartState
from service.storage.database import Database
from service.storage.disk import Disk
from service.storage.files import Files


@dataclass(frozen=True)
class Storage:
    """The storage of a running service, and the limits of what is put there."""

    settings: Settings
    database: Database
    files: Files
    disk: Disk

    @classmethod
    def open(cls, settings: Settings) -> Storage:
        """Open, or make, what the settings name."""
        return cls(settings, Database.of(settings, settings.database_timeout_s), Files.of(settings), Disk(settings))


StorageDep = Annotated[Storage, Depends(of_app("storage"))]


WRITE_S = 2.0
"""Longest wait in s for another writer of the database: commits take milliseconds."""
PROBE = bytes(4096)


def look_database(storage: Storage) -> tuple[PartState, str]:
    """Whether the database answers, and can be written in time."""
    with storage.database.session() as session:
        session.execute(text("SELECT 1"))
    storage.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def look_home(storage: Storage) -> tuple[PartState, str]:
    """Whether the home can be written, and has room."""
    path = storage.files.upload()
    try:
        path.write_bytes(PROBE)
    finally:
        path.unlink(missing_ok=True)
    shortage = storage.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def look_files(storage: Storage) -> tuple[PartState, str]:
    """Whether the shared store answers: without it, what is in memory and what has a copy here still does."""
    try:
        storage.files.check()
    except OSError as error:
        return "warning", f"{error.strerror or error}: nothing can be uploaded, trained or loaded"
    return "ok", "the shared store answers"
