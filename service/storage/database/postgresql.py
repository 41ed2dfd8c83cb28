"""PostgreSQL: the database that several services share.

Writers are kept apart by advisory locks, so that code above sees what SQLite gives it: one writer at a time, of a model
or of all. They end with the transaction, and so with a process or a host that dies.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any
from zlib import crc32

import psycopg
from psycopg.abc import Buffer
from psycopg.types.string import StrDumperUnknown
from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError

from service.storage.database.engine import CHANNEL

WRITERS, TURNS = 0x4C495053, 0x4C495054
"""Names of the two kinds of locks among those of the database."""
ALL = 0
OPTIONS = {
    "idle_in_transaction_session_timeout": "60s",  # a service that hangs shall not keep its locks for ever
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
}
NOTICED: dict[str, Any] = {
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}
"""A server that is gone without a word, as behind a network that is silent, is noticed within half a minute; the
system's own times are a quarter of an hour, and two hours."""
LISTENING: dict[str, Any] = {"application_name": "lipserve notices", "connect_timeout": 5, **NOTICED}


class Postgresql:
    """One server, many services. Sessions are at READ COMMITTED, PostgreSQL's default."""

    shared = True

    def __init__(self, url: str, timeout_s: float, connections: int) -> None:
        turns = max(1, connections // 4)
        self.engine = _engine(url, timeout_s, max(1, connections - turns))
        # who has a turn needs another connection, which none of those that wait for a turn may have
        self._turns = _engine(url, timeout_s, turns)

    def queue(self) -> AbstractContextManager[None]:
        """Nothing to wait for: the server knows who comes next."""
        return nullcontext()

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Wait until no other writer of the model, or none at all, is left; the lock ends with the transaction."""
        if model is None:
            _take(connection, "pg_advisory_xact_lock", WRITERS, ALL)
            return
        _take(connection, "pg_advisory_xact_lock_shared", WRITERS, ALL)
        _take(connection, "pg_advisory_xact_lock", WRITERS, _key(model))

    def pin(self, connection: Connection) -> None:
        """Let all that is read from now on be of the moment of the first look."""
        connection.execute(text("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY"))

    @contextmanager
    def turn(self, model: str) -> Iterator[None]:
        """Wait until no other service has the turn of the model; on a connection of its own."""
        with self._turns.connect() as connection:
            _take(connection, "pg_advisory_xact_lock", TURNS, _key(model))
            yield

    def changes_of_others(self, pause_s: float) -> Iterator[str | None]:
        """Payloads of notices, on a connection of its own; None once it listens, and after each pause of so long, s."""
        url = self.engine.url.set(drivername="postgresql").render_as_string(hide_password=False)
        with psycopg.connect(url, autocommit=True, **LISTENING) as connection:
            connection.execute(f"LISTEN {CHANNEL}")
            while True:
                yield None
                for notice in connection.notifies(timeout=pause_s):
                    yield notice.payload

    def check(self, seconds: float) -> None:
        """Raise an error unless the server answers and takes writes of a model within so many seconds.

        Others need not be done for that: what looks every second must not hold up those that write.
        """
        with self.engine.connect() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = {max(1, round(1000 * seconds))}"))
            if connection.scalar(text("SELECT pg_is_in_recovery()")):
                raise OSError("the PostgreSQL server is a standby, which cannot be written")
            _take(connection, "pg_advisory_xact_lock_shared", WRITERS, ALL)

    def settle(self) -> None:
        """Nothing: PostgreSQL ends where a sync of its log fails."""

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()
        self._turns.dispose()

    def damage(self) -> list[str]:
        """Nothing: PostgreSQL looks after itself (its checksums, `pg_amcheck`)."""
        return []

    def inconsistencies(self, most: int) -> list[str]:
        """Nothing either: it holds to its references."""
        return []


def _engine(url: str, timeout_s: float, most: int) -> Engine:
    options = OPTIONS | {"lock_timeout": f"{max(1, round(1000 * timeout_s))}ms"}
    made = create_engine(
        _read(url),
        connect_args={
            "options": " ".join(f"-c {name}={value}" for name, value in options.items()),
            "connect_timeout": max(2, round(timeout_s)),
            "application_name": "lipserve",
            **NOTICED,
        },
        pool_pre_ping=True,  # connections do not outlive a restart of the server
        pool_size=min(5, most),
        max_overflow=max(0, most - 5),
        pool_timeout=timeout_s,
        json_serializer=_json,
    )
    event.listen(made, "connect", _configure)
    return made


class _Text(StrDumperUnknown):
    """Text without NUL, which PostgreSQL has no way to hold: a name with one is then looked for and not found."""

    def dump(self, obj: str) -> Buffer | None:
        return super().dump(obj.replace("\0", "\ufffd"))


def _configure(connection: psycopg.Connection[Any], _: object) -> None:
    connection.adapters.register_dumper(str, _Text)


def _json(value: Any) -> str:
    """JSON as PostgreSQL has it, where numbers that are none are null. All others come back as they were."""
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError:
        return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))


def _read(url: str) -> URL:
    try:
        return make_url(url).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError):  # without what it says, which may be half of a password
        raise ArgumentError(
            "LIPSERVE_DATABASE_URL cannot be read, expected postgresql://user:password@host:port/name, with what is "
            "neither letter nor digit in the password as %XX"
        ) from None


def _take(connection: Connection, function: str, kind: int, key: int) -> None:
    connection.execute(text(f"SELECT {function}(:kind, :key)"), {"kind": kind, "key": key})


def _key(model: str) -> int:
    """A number for a model, never ALL; two of the same number only wait for each other."""
    return (crc32(model.encode()) & 0x7FFFFFFF) or 1
