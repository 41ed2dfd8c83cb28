"""Sessions on the database: SQLite below the home, or a PostgreSQL server that several services share.

There a transaction tells the others of which model it has changed what: PostgreSQL sends notices with the commit
(`NOTIFY`), and of what was rolled back nobody hears. Who was not connected then has missed it, and looks for itself.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import chain
from pathlib import Path
from secrets import token_hex
from typing import Any, Literal, NamedTuple, Protocol

from sqlalchemy import Connection, Engine, event, text
from sqlalchemy.orm import Session, sessionmaker

from service.foundation.settings import CONNECTIONS, Settings
from service.storage.database.migrations import migrate
from service.storage.database.sqlite import Sqlite
from service.storage.database.tables import (
    AliasRow,
    Base,
    DeletedModelRow,
    EventRow,
    LearnerRow,
    ServingRow,
    VersionRow,
)

CHANNEL = "lipserve"
Kind = Literal["log", "model"]
KINDS: dict[type[Base], Kind] = {
    EventRow: "log",
    VersionRow: "model",
    ServingRow: "model",
    AliasRow: "model",
    LearnerRow: "model",
    DeletedModelRow: "model",
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
            model = row.name if isinstance(row, DeletedModelRow) else row.model
            changes.add((KINDS[type(row)], model))


def send_notices(session: Session, origin: str) -> None:
    """Tell with the commit of a session what it has changed."""
    session.flush()
    for kind, model in sorted(session.info.pop(_KEY, ())):
        payload = Notice(kind, model, origin).payload()
        session.execute(text("SELECT pg_notify(:channel, :payload)"), {"channel": CHANNEL, "payload": payload})


PATIENCE_S = 30.0
"""Longest wait for another writer, of processes that nobody waits for."""


class DriverMissingError(RuntimeError):
    """What PostgreSQL needs is not installed."""


class Adapter(Protocol):
    """What SQLite and PostgreSQL do differently."""

    engine: Engine
    shared: bool
    """Whether other services may write to it too."""

    def lock(self, connection: Connection, model: str | None) -> None:
        """Begin a transaction of a writer: the only one of a model, or the only one of all where None."""

    def turn(self, model: str) -> AbstractContextManager[None]:
        """Be the only one, of all services, that takes something for a model while the block runs."""

    def changes_of_others(self, pause_s: float) -> Iterator[str | None]:
        """What other services tell, see `Database.changes_of_others`."""

    def close(self) -> None:
        """Close all connections."""

    def check(self, seconds: float) -> None:
        """Raise an error unless the database can be read and written within so many seconds."""

    def damage(self, most: int = 1) -> list[str]:
        """What the database finds wrong with itself, at most so many faults; empty where it is whole."""

    def inconsistencies(self, most: int) -> list[str]:
        """As `damage`, looked at more closely, and rows that refer to none."""


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

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Session for reading: every statement sees what was committed before it."""
        with self._sessions() as session:
            yield session

    @contextmanager
    def transaction(self, model: str | None = None) -> Iterator[Session]:
        """Session whose changes are committed at the end, all or none; what is read inside cannot change before.

        model: where given, only rows of this model are written, so that those of other models need not wait (which
        SQLite's writers do all the same); else it is the only writer.
        """
        with self._sessions() as session:
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

    def close(self) -> None:
        """Close all connections."""
        self.adapter.close()


def _adapter(home: Path, timeout_s: float, url: str | None, connections: int) -> Adapter:
    if url is None:
        return Sqlite(home, timeout_s)
    try:
        from service.storage.database.postgresql import Postgresql  # noqa: PLC0415 - its driver is an extra
    except ModuleNotFoundError as error:
        raise DriverMissingError("LIPSERVE_DATABASE_URL needs more: pip install 'lipserve[cluster]'") from error
    return Postgresql(url, timeout_s, connections)
