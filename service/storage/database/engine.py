"""Sessions on the database: SQLite below the home, or a PostgreSQL server that several services share.

On PostgreSQL a transaction notifies the other services which models it changed. The server sends notices with the
commit (`NOTIFY`), and none after a rollback. A service that was not connected missed them, and reads the tables
instead.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from itertools import chain
from pathlib import Path
from secrets import token_hex
from sqlite3 import connect
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from urllib.parse import quote

from sqlalchemy import Connection, CursorResult, Select, create_engine, event, text
from sqlalchemy.orm import Session, sessionmaker

from lipcore.extras import import_extra
from lipcore.files.durable import make_folder
from service.foundation.settings import CONNECTIONS, Settings
from service.storage.database import tables
from service.storage.database.migrations import migrate
from service.storage.database.texts import find_unreadable_texts

if TYPE_CHECKING:
    from service.storage.database.postgresql import Postgresql

logger = logging.getLogger(__name__)

FILE = "lipserve.sqlite3"
LOG_BYTES = 4 * 1024 * 1024
"""Max size of SQLite's log after a restart of it; SQLite copies the log into the database every 1000 pages."""


class Sqlite:
    """One file, one service, one writer at a time."""

    shared = False

    def __init__(self, home: Path, timeout_s: float) -> None:
        make_folder(home, 0o700)
        self.path = home / FILE
        self.path.touch(0o600)  # readable by its owner only, like the files that SQLite puts beside it
        self.engine = create_engine(
            f"sqlite:///{self.path}",
            connect_args={"timeout": timeout_s},
            max_overflow=64,  # more than there are threads: readers do not wait for waiting writers
            pool_timeout=timeout_s,
        )
        event.listen(self.engine, "connect", _configure)
        self._timeout_s, self._writers = timeout_s, threading.Lock()

    @contextmanager
    def queue(self) -> Iterator[None]:
        """Wait for the other writers of this process, up to `timeout_s`; then SQLite rejects the write.

        SQLite's own wait retries only every 0.1 s, and another writer may be first each time.
        """
        held = self._writers.acquire(timeout=self._timeout_s)
        try:
            yield
        finally:
            if held:
                self._writers.release()

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Acquire the only write lock: later reads of the transaction cannot change before its writes."""
        connection.execute(text("BEGIN IMMEDIATE"))

    def pin(self, connection: Connection) -> None:
        """Make all reads of the transaction see the moment of its first read; writers do not wait for it."""
        connection.execute(text("BEGIN"))

    @contextmanager
    def turn(self, model: str) -> Iterator[None]:
        """Do nothing: no other service uses this file."""
        yield

    def changes_of_others(self, pause_s: float) -> Iterator[str | None]:
        """Return no changes: no other service writes to this file."""
        return iter(())

    def check(self, seconds: float) -> None:
        """Raise an error unless a transaction can begin within `seconds`."""
        # a connection of its own: requests may wait longer for each other than this check
        with closing(connect(f"file:{quote(str(self.path))}?mode=rw", seconds, isolation_level=None, uri=True)) as own:
            own.execute("BEGIN IMMEDIATE")
            own.execute("ROLLBACK")

    def settle(self) -> None:
        """Copy the log that an earlier run left into the database, and start a new log on the disk.

        The readable log may not be on the disk, if a sync failed. Commits appended after such a gap would be lost with
        it at the next power cut. Call it in the first process, before it answers.
        """
        with self.engine.connect() as connection:
            busy, _, _ = connection.execute(text("PRAGMA wal_checkpoint(TRUNCATE)")).one()
        if busy:
            logger.warning("another process reads the database, so its write-ahead log could not be emptied")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def damage(self) -> list[str]:
        """Return the first fault of pages or texts; takes about 0.5 s per GB, and 4 µs per batch of the log."""
        return self._faults("quick_check", 1)

    def inconsistencies(self, most: int) -> list[str]:
        """Return broken references, and the faults of `integrity_check` or unreadable texts; slower than `damage`."""
        with self.engine.connect() as connection:
            rows = list(connection.execute(text("PRAGMA foreign_key_check")))
        return [
            *self._faults("integrity_check", most),
            *(f"a row of {r[0]} refers to a missing row of {r[2]}" for r in rows),
        ]

    def _faults(self, check: str, most: int) -> list[str]:
        with self.engine.connect() as connection:
            faults = [str(each) for each in connection.scalars(text(f"PRAGMA {check}({int(most)})"))]
            return find_unreadable_texts(connection, most) if faults == ["ok"] else faults


def _configure(connection: Any, _: object) -> None:
    connection.isolation_level = None  # `lock` begins transactions, not the driver
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    # a log that grew during a long read, such as a backup, is cut to this size when it restarts
    cursor.execute(f"PRAGMA journal_size_limit={LOG_BYTES}")
    cursor.close()


def fetch(session: Session, statement: Select[Any], **parameters: object) -> CursorResult[Any]:
    """Return the rows of a prepared statement with parameters (`bindparam`), including the session's own changes.

    For columns that are read for every batch: a new statement each time, and an object per row, take six times as long.
    """
    session.flush()
    return session.connection().execute(statement, parameters)


CHANNEL = "lipserve"
Kind = Literal["log", "model"]
KINDS: dict[type[tables.Base], Kind] = {
    tables.EventRow: "log",
    tables.VersionRow: "model",
    tables.ServingRow: "model",
    tables.AliasRow: "model",
    tables.LearnerRow: "model",
    tables.DeletedModelRow: "model",
}
_KEY = "notices"


class Notice(NamedTuple):
    """A change of a model by another service."""

    kind: Kind
    """`log` if its log grew, `model` if its versions, aliases or roles changed or it was deleted."""
    model: str
    origin: str
    """The `origin` of the database object that made the change."""

    def payload(self) -> str:
        """Return the text to send; `read_notice` is its inverse."""
        return f"{self.kind} {self.origin} {self.model}"


def read_notice(payload: str) -> Notice | None:
    """Return the notice of a received text; None if it is from another release."""
    kind, _, rest = payload.partition(" ")
    origin, _, model = rest.partition(" ")
    if kind == "log":
        return Notice("log", model, origin)
    return Notice("model", model, origin) if kind == "model" else None


def collect_notices(session: Session, _: Any) -> None:
    """Record the models that a session writes; call it after each flush.

    Changes made by a statement alone are not seen: each of them comes with a row that is.
    """
    changes = session.info.setdefault(_KEY, set())
    row: Any
    for row in chain(session.new, session.dirty, session.deleted):
        if type(row) in KINDS:
            model = row.name if isinstance(row, tables.DeletedModelRow) else row.model
            changes.add((KINDS[type(row)], model))


def send_notices(session: Session, origin: str) -> None:
    """Send the session's notices with its commit."""
    session.flush()
    for kind, model in sorted(session.info.pop(_KEY, ())):
        payload = Notice(kind, model, origin).payload()
        session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})


PATIENCE_S = 30.0
"""Max wait for another writer in processes that no request waits for, s."""


class Database:
    """Sessions on one database; safe to share between threads.

    - timeout_s: max wait for another writer, s.
    - url: address of a PostgreSQL server; None: SQLite in the home.
    - connections: max open connections to PostgreSQL.
    - adapter: of another kind, by default the one that the other arguments name.
    - origin: random id of this object in notices to other services.
    """

    def __init__(
        self,
        home: Path,
        timeout_s: float = PATIENCE_S,
        url: str | None = None,
        connections: int = CONNECTIONS,
        adapter: Sqlite | None = None,
    ) -> None:
        self.adapter = adapter or _adapter(home, timeout_s, url, connections)
        self.engine = self.adapter.engine
        migrate(self.engine, self.adapter.lock)
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)
        self.origin = token_hex(8)
        if self.shared:
            event.listen(self._sessions, "after_flush", collect_notices)

    @classmethod
    def of(cls, settings: Settings, timeout_s: float = PATIENCE_S) -> Database:
        """Return the database that the settings name."""
        return cls(settings.home, timeout_s, settings.database_url, settings.database_connections)

    @property
    def shared(self) -> bool:
        """Return whether other services may write to the same database."""
        return self.adapter.shared

    @property
    def own_clock(self) -> bool:
        """Return whether only this machine's clock dates the stored rows."""
        return not self.shared

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Yield a session for reading: every statement sees the commits before it."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def moment(self) -> Iterator[Session]:
        """Yield a session for reading at one moment. No writer waits for it."""
        with self._sessions() as session:
            self.adapter.pin(session.connection())
            yield session

    @contextmanager
    def transaction(self, model: str | None = None) -> Iterator[Session]:
        """Yield a session that commits all changes at the end, or none; what it reads cannot change before.

        model: write only rows of this model, so that PostgreSQL's writers of other models need not wait. None makes it
        the only writer.
        """
        with self.adapter.queue(), self._sessions() as session:
            self.adapter.lock(session.connection(), model)
            yield session
            if self.shared:
                send_notices(session, self.origin)
            session.commit()

    def turn(self, model: str) -> AbstractContextManager[None]:
        """Wait to be the only service that runs such a block for a model.

        For reads before the transaction that records them. A service alone needs no turn.
        """
        return self.adapter.turn(model)

    def changes_of_others(self, pause_s: float) -> Generator[Notice | None, None, None]:
        """Yield the commits of others after the first None, and None after each pause, s.

        It raises an error if the connection is lost. It ends at once if no other service shares the database.
        """
        for payload in self.adapter.changes_of_others(pause_s):
            notice = None if payload is None else read_notice(payload)
            if payload is None or notice is not None:
                yield notice

    def follow_others(self, start: Callable[[], Callable[[], None]]) -> Callable[[], None]:
        """Start following the changes of others; return the function that stops it. A service alone starts nothing."""
        return start() if self.shared else lambda: None

    def close(self) -> None:
        """Close all connections."""
        self.adapter.close()


def _adapter(home: Path, timeout_s: float, url: str | None, connections: int) -> Sqlite | Postgresql:
    if url is None:
        return Sqlite(home, timeout_s)
    import_extra("psycopg", "cluster", "LIPSERVE_DATABASE_URL is set")
    from service.storage.database.postgresql import Postgresql  # noqa: PLC0415 - its driver is an extra

    return Postgresql(url, timeout_s, connections)
