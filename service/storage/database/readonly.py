"""The database of a home that this process cannot write to, for verification: nothing is written there."""

from __future__ import annotations

import os
import shutil
import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

from sqlalchemy import Connection, create_engine
from sqlalchemy.pool import NullPool

from service.storage.database.engine import FILE, Sqlite
from service.storage.database.migrations import DatabaseVersionError


def is_read_only(home: Path) -> bool:
    """Return whether this process cannot write to a home: its disk is mounted so, or permissions are missing."""
    effective = os.access in os.supports_effective_ids
    return not all(os.access(each, os.W_OK, effective_ids=effective) for each in (home, home / FILE))


class ReadOnlySqlite(Sqlite):
    """The database of a read-only home.

    Without a write-ahead log no service uses the home, so the file is read without locks. A service that runs or was
    killed leaves a log with the newest commits and, beside it, an index (`-shm`). SQLite reads the log with this index.
    A log without index is read in a temporary copy of both files.
    """

    def __init__(self, home: Path, timeout_s: float) -> None:
        self.path = home / FILE
        self._copy: TemporaryDirectory[str] | None = None
        log, index = (self.path.with_name(FILE + end) for end in ("-wal", "-shm"))
        mode = "mode=ro"
        if not log.exists():
            mode += "&immutable=1"
        elif not index.exists():
            self._copy = TemporaryDirectory(prefix="lipserve-verify-")
            for each in (self.path, log):
                shutil.copyfile(each, Path(self._copy.name) / each.name)
            self.path, mode = Path(self._copy.name) / FILE, "mode=rw"
        address = f"file:{quote(str(self.path))}?{mode}"

        def connect() -> sqlite3.Connection:
            return sqlite3.connect(address, timeout_s, isolation_level=None, check_same_thread=False, uri=True)

        self.engine = create_engine("sqlite://", creator=connect, poolclass=NullPool)

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Raise DatabaseVersionError: only a migration would write."""
        raise DatabaseVersionError(
            "the database is of another release and its home is read-only: run `lipserve verify` on a copy of the home"
        )

    def close(self) -> None:
        """Close all connections, and delete the copy."""
        super().close()
        if self._copy is not None:
            self._copy.cleanup()
