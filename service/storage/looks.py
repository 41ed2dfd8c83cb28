"""Whether the service can read and write what it keeps; see `web.observability.readiness`."""

from __future__ import annotations

from sqlalchemy import text

from service.foundation.states import PartState
from service.storage.storage import Storage

WRITE_S = 2.0
"""Longest wait in s for another writer of the database: commits take milliseconds."""
PROBE = bytes(4096)


def database(storage: Storage) -> tuple[PartState, str]:
    """Whether the database answers, and can be written in time."""
    with storage.database.session() as session:
        session.execute(text("SELECT 1"))
    storage.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def home(storage: Storage) -> tuple[PartState, str]:
    """Whether the home can be written, and has room."""
    path = storage.files.upload()
    try:
        path.write_bytes(PROBE)
    finally:
        path.unlink(missing_ok=True)
    shortage = storage.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def files(storage: Storage) -> tuple[PartState, str]:
    """Whether the shared store answers: without it, what is in memory and what has a copy here still does."""
    try:
        storage.files.check()
    except OSError as error:
        return "warning", f"{error.strerror or error}: nothing can be uploaded, trained or loaded"
    return "ok", "the shared store answers"
