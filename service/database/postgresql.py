"""PostgreSQL: the database that several services share.

Writers are kept apart by advisory locks, so that code above sees what SQLite gives it: one writer at a time, of a model
or of all. They end with the transaction, and so with a process or a host that dies.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from zlib import crc32

from sqlalchemy import Connection, create_engine, make_url, text

WRITERS, TURNS = 0x4C495053, 0x4C495054
"""Names of the two kinds of locks among those of the database."""
ALL = 0
CONNECTIONS = 20
OPTIONS = {
    "idle_in_transaction_session_timeout": "60s",  # a service that hangs shall not keep its locks for ever
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
}


class Postgresql:
    """One server, many services. Sessions are at READ COMMITTED, PostgreSQL's default."""

    shared = True

    def __init__(self, url: str, timeout_s: float, connections: int | None = None) -> None:
        options = OPTIONS | {"lock_timeout": f"{max(1, round(1000 * timeout_s))}ms"}
        most = CONNECTIONS if connections is None else connections
        self.engine = create_engine(
            make_url(url).set(drivername="postgresql+psycopg"),
            connect_args={
                "options": " ".join(f"-c {name}={value}" for name, value in options.items()),
                "connect_timeout": max(2, round(timeout_s)),
                "application_name": "lipserve",
            },
            pool_pre_ping=True,  # connections do not outlive a restart of the server
            pool_size=min(5, most),
            max_overflow=max(0, most - 5),
            pool_timeout=timeout_s,
        )

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Wait until no other writer of the model, or none at all, is left; the lock ends with the transaction."""
        if model is None:
            _take(connection, "pg_advisory_xact_lock", WRITERS, ALL)
            return
        _take(connection, "pg_advisory_xact_lock_shared", WRITERS, ALL)
        _take(connection, "pg_advisory_xact_lock", WRITERS, _key(model))

    @contextmanager
    def turn(self, model: str) -> Iterator[None]:
        """Wait until no other service has the turn of the model; on a connection of its own."""
        with self.engine.connect() as connection:
            _take(connection, "pg_advisory_xact_lock", TURNS, _key(model))
            yield

    def check(self, seconds: float) -> None:
        """Raise an error unless the server answers, and takes writes, with every writer done within so many seconds."""
        with self.engine.connect() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = {max(1, round(1000 * seconds))}"))
            if connection.scalar(text("SELECT pg_is_in_recovery()")):
                raise OSError("the PostgreSQL server is a standby, which cannot be written")
            self.lock(connection)

    def damage(self, most: int = 1) -> list[str]:
        """Nothing: PostgreSQL looks after itself (its checksums, `pg_amcheck`)."""
        return []


def _take(connection: Connection, function: str, kind: int, key: int) -> None:
    connection.execute(text(f"SELECT {function}(:kind, :key)"), {"kind": kind, "key": key})


def _key(model: str) -> int:
    """A number for a model, never ALL; two of the same number only wait for each other."""
    return (crc32(model.encode()) & 0x7FFFFFFF) or 1
