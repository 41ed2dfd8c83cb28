"""Sessions on the database: SQLite in WAL mode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import create_engine, event, text
from sqlalchemy.orm import Session, sessionmaker

from service.database.migrations import migrate

FILE = "lipserve.sqlite3"
PATIENCE_S = 30.0
"""Longest wait for another writer, of processes that nobody waits for."""
MOST_CONNECTIONS = 64
"""More than there are threads: who only reads shall not wait for those that wait to write."""


class Database:
    """Sessions on one database; safe to share between threads. timeout_s: longest wait for another writer."""

    def __init__(self, home: Path, timeout_s: float = PATIENCE_S) -> None:
        home.mkdir(parents=True, exist_ok=True)
        self.engine = create_engine(
            f"sqlite:///{home / FILE}",
            connect_args={"timeout": timeout_s},
            max_overflow=MOST_CONNECTIONS,
            pool_timeout=timeout_s,
        )
        event.listen(self.engine, "connect", _configure)
        migrate(self.engine)
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Session for reading."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def transaction(self) -> Iterator[Session]:
        """Session whose changes are committed at the end, all or none; one writer at a time."""
        with self._sessions() as session:
            # taking the write lock first: what is read inside cannot change before it is written
            session.execute(text("BEGIN IMMEDIATE"))
            yield session
            session.commit()

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def _configure(connection: Any, _: object) -> None:
    connection.isolation_level = None  # transactions are begun by `transaction`, not by the driver
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()
