"""Sessions on the database: SQLite below the home, or a PostgreSQL server that several services share.

There a transaction tells the others of which model it has changed what: PostgreSQL sends notices with the commit
(`NOTIFY`), and of what was rolled back nobody hears. Who was not connected then has missed it, and looks for itself.
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

from lipcore.extras import need
from lipcore.files.durable import make_folder
from service.foundation.settings import CONNECTIONS, Settings
from service.storage.database import tables
from service.storage.database.migrations import migrate

if TYPE_CHECKING:
    from service.storage.database.postgresql import Postgresql

logger = logging.getLogger(__name__)

FILE = "lipserve.sqlite3"
LOG_BYTES = 4 * 1024 * 1024
"""Of SQLite's log, which by itself it brings into the database every 1000 pages."""


class Sqlite:
    """One file, one service, one writer at a time."""

    shared = False

    def __init__(self, home: Path, timeout_s: float) -> None:
        make_folder(home, 0o700)
        self.path = home / FILE
        self.path.touch(0o600)  # for its owner alone, as what SQLite puts beside it
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
        """Wait for the other writers of this process. SQLite by itself tries again only after up to 0.1 s, and then
        another one may have come first. After `timeout_s` it is SQLite that refuses."""
        held = self._writers.acquire(timeout=self._timeout_s)
        try:
            yield
        finally:
            if held:
                self._writers.release()

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Take the write lock, of which there is one: what is read from now on cannot change before it is written."""
        connection.execute(text("BEGIN IMMEDIATE"))

    def pin(self, connection: Connection) -> None:
        """Let all that is read from now on be of the moment of the first look; writers are not kept."""
        connection.execute(text("BEGIN"))

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

    def settle(self) -> None:
        """Bring what an earlier run has left in SQLite's log into the database and begin the log anew, on the disk.

        What is read of a log need not be on the disk: a sync may have failed. Commits that were added behind such a gap
        would be lost with it at the next power cut. To be called by the first process, before it answers.
        """
        with self.engine.connect() as connection:
            busy, _, _ = connection.execute(text("PRAGMA wal_checkpoint(TRUNCATE)")).one()
        if busy:
            logger.warning("another process reads the database: the log of its writes is kept until it is full")

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()

    def damage(self) -> list[str]:
        """What `quick_check` finds wrong; takes about 0.3 s for each GB."""
        return self._faults("quick_check", 1)

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
    # a log that has grown while somebody read for long, as a backup does, is cut to this when it begins anew
    cursor.execute(f"PRAGMA journal_size_limit={LOG_BYTES}")
    cursor.close()


def fetch(session: Session, statement: Select[Any], **parameters: object) -> CursorResult[Any]:
    """Rows of a statement that is made once, with parameters (`bindparam`); what the session has changed is in them.

    For columns that are read for every batch: to make a statement each time, and an object of each row, takes six times
    as long.
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
    """kind: `log` of a model that has grown, `model` whose versions, aliases or roles have changed or that is gone;
    origin: who has changed it."""

    kind: Kind
    model: str
    origin: str

    def payload(self) -> str:
        """What is sent; `read` is its inverse."""
        return f"{self.kind} {self.origin} {self.model}"


def read_notice(payload: str) -> Notice | None:
    """A notice that was sent; None for what is none of this release."""
    kind, _, rest = payload.partition(" ")
    origin, _, model = rest.partition(" ")
    if kind == "log":
        return Notice("log", model, origin)
    return Notice("model", model, origin) if kind == "model" else None


def collect_notices(session: Session, _: Any) -> None:
    """Note what is written to a session; to be called after each flush of it.

    Rows that are changed by a statement alone pass unseen: each such change comes with a row that does not.
    """
    changes = session.info.setdefault(_KEY, set())
    row: Any
    for row in chain(session.new, session.dirty, session.deleted):
        if type(row) in KINDS:
            model = row.name if isinstance(row, tables.DeletedModelRow) else row.model
            changes.add((KINDS[type(row)], model))


def send_notices(session: Session, origin: str) -> None:
    """Tell with the commit of a session what it has changed."""
    session.flush()
    for kind, model in sorted(session.info.pop(_KEY, ())):
        payload = Notice(kind, model, origin).payload()
        session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})


PATIENCE_S = 30.0
"""Longest wait for another writer, of processes that nobody waits for."""


class Database:
    """Sessions on one database; safe to share between threads. timeout_s: longest wait for another writer.

    url: of a PostgreSQL server, None for SQLite below the home. connections: most that are open at a time there.
    origin: by which others know who has changed something.
    """

    def __init__(
        self, home: Path, timeout_s: float = PATIENCE_S, url: str | None = None, connections: int = CONNECTIONS
    ) -> None:
        self.adapter = _adapter(home, timeout_s, url, connections)
        self.engine = self.adapter.engine
        migrate(self.engine, self.adapter.lock)
        self._sessions = sessionmaker(self.engine, expire_on_commit=False)
        self.origin = token_hex(8)
        if self.shared:
            event.listen(self._sessions, "after_flush", collect_notices)

    @classmethod
    def of(cls, settings: Settings, timeout_s: float = PATIENCE_S) -> Database:
        """The database that the settings name."""
        return cls(settings.home, timeout_s, settings.database_url, settings.database_connections)

    @property
    def shared(self) -> bool:
        """Whether other services may write to it too."""
        return self.adapter.shared

    @property
    def own_clock(self) -> bool:
        """Whether this machine's clock alone dates what is stored."""
        return not self.shared

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Session for reading: every statement sees what was committed before it."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def moment(self) -> Iterator[Session]:
        """Session for reading: everything as of one moment. Nobody waits for it."""
        with self._sessions() as session:
            self.adapter.pin(session.connection())
            yield session

    @contextmanager
    def transaction(self, model: str | None = None) -> Iterator[Session]:
        """Session whose changes are committed at the end, all or none; what is read inside cannot change before.

        model: where given, only rows of this model are written, so that those of other models need not wait (which
        SQLite's writers do all the same); else it is the only writer.
        """
        with self.adapter.queue(), self._sessions() as session:
            self.adapter.lock(session.connection(), model)
            yield session
            if self.shared:
                send_notices(session, self.origin)
            session.commit()

    def turn(self, model: str) -> AbstractContextManager[None]:
        """Be the only one, of all services that share the database, that takes something for a model meanwhile.

        For what is read before the transaction that writes it down. Nothing needs it where there is one service.
        """
        return self.adapter.turn(model)

    def changes_of_others(self, pause_s: float) -> Generator[Notice | None, None, None]:
        """What is changed from the first None on that this yields, as it is committed; and None after each pause, s.

        Ends with an error where the connection does. Where there is one service, nothing is told and this ends at once.
        """
        for payload in self.adapter.changes_of_others(pause_s):
            notice = None if payload is None else read_notice(payload)
            if payload is None or notice is not None:
                yield notice

    def follow_others(self, start: Callable[[], Callable[[], None]]) -> Callable[[], None]:
        """Start what follows the changes of others, and return what stops it. A service alone starts nothing."""
        return start() if self.shared else lambda: None

    def close(self) -> None:
        """Close all connections."""
        self.adapter.close()


def _adapter(home: Path, timeout_s: float, url: str | None, connections: int) -> Sqlite | Postgresql:
    if url is None:
        return Sqlite(home, timeout_s)
    need("psycopg", "cluster", "LIPSERVE_DATABASE_URL is set")
    from service.storage.database.postgresql import Postgresql  # noqa: PLC0415 - its driver is an extra

    return Postgresql(url, timeout_s, connections)
