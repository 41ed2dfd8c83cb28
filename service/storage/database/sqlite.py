"""SQLite in WAL mode: the database of one service, a file below its home."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from sqlite3 import connect
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, create_engine, event, text

FILE = "lipserve.sqlite3"
MOST_CONNECTIONS = 64
"""More than there are threads: who only reads shall not wait for those that wait to write."""


class Sqlite:
    """One file, one service, one writer at a time."""

    shared = False

    def __init__(self, home: Path, timeout_s: float) -> None:
        home.mkdir(parents=True, exist_ok=True)
        self.path = home / FILE
        self.engine = create_engine(
            f"sqlite:///{self.path}",
            connect_args={"timeout": timeout_s},
            max_overflow=MOST_CONNECTIONS,
            pool_timeout=timeout_s,
        )
        event.listen(self.engine, "connect", _configure)

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Take the write lock, of which there is one: what is read from now on cannot change before it is written."""
        connection.execute(text("BEGIN IMMEDIATE"))

    @contextmanager
    def turn(self, model: str) -> Iterator[None]:
        """Nothing to wait for: no other service has this file."""
        yield

    def changes_of_others(self, pause_s: float) -> Iterator[str | None]:
        """Nothing, at once: nobody else writes to this file."""
        return iter(())

    def check(self, seconds: float) -> None:
        """Raise an error unless a transaction can be begun within so many seconds."""
        # a connection of its own: requests wait longer for each other than this should
        with closing(connect(f"file:{quote(str(self.path))}?mode=rw", seconds, isolation_level=None, uri=True)) as own:
            own.execute("BEGIN IMMEDIATE")
            own.execute("ROLLBACK")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def damage(self, most: int = 1) -> list[str]:
        """What `quick_check` finds wrong; takes about 0.3 s for each GB."""
        return self._faults("quick_check", most)

    def inconsistencies(self, most: int) -> list[str]:
        """What `integrity_check` finds wrong, and rows that refer to none; several times as long as `damage`."""
        with self.engine.connect() as connection:
            rows = list(connection.execute(text("PRAGMA foreign_key_check")))
        return [*self._faults("integrity_check", most), *(f"a row of {r[0]} refers to no row of {r[2]}" for r in rows)]

    def _faults(self, check: str, most: int) -> list[str]:
        with self.engine.connect() as connection:
            faults = [str(each) for each in connection.scalars(text(f"PRAGMA {check}({int(most)})"))]
        return [] if faults == ["ok"] else faults


def _configure(connection: Any, _: object) -> None:
    connection.isolation_level = None  # transactions are begun by `lock`, not by the driver
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()
