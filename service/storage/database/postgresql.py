"""PostgreSQL: the database that several services share.

Advisory locks separate the writers as SQLite does: one writer at a time, of a model or of all. A lock ends with its
transaction, and so with a process or host that dies.
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
"""The two kinds of our advisory locks."""
ALL_MODELS = 0
OPTIONS = {
    "idle_in_transaction_session_timeout": "60s",  # a hung service must not keep its locks for ever
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
}
KEEPALIVE_OPTIONS: dict[str, Any] = {
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}
"""Options that detect within half a minute that the server cannot be reached. The default timeouts of the system are
15 minutes and two hours."""
LISTENER_OPTIONS: dict[str, Any] = {"application_name": "lipserve notices", "connect_timeout": 5, **KEEPALIVE_OPTIONS}


class Postgresql:
    """One server, many services. Sessions are at READ COMMITTED, PostgreSQL's default."""

    shared = True

    def __init__(self, url: str, timeout_s: float, connections: int) -> None:
        turns = max(1, connections // 4)
        self.engine = _engine(url, timeout_s, max(1, connections - turns))
        # the owner of a turn needs another connection, which no waiter for a turn may occupy
        self._turns = _engine(url, timeout_s, turns)

    def queue(self) -> AbstractContextManager[None]:
        """Do nothing: the server queues the writers."""
        return nullcontext()

    def lock(self, connection: Connection, model: str | None = None) -> None:
        """Wait until no other writer of the model, or of any model, is left; the lock ends with the transaction."""
        if model is None:
            _lock(connection, "pg_advisory_xact_lock", WRITERS, ALL_MODELS)
            return
        _lock(connection, "pg_advisory_xact_lock_shared", WRITERS, ALL_MODELS)
        _lock(connection, "pg_advisory_xact_lock", WRITERS, _key(model))

    def pin(self, connection: Connection) -> None:
        """Make all reads of the transaction see the moment of its first read."""
        connection.execute(text("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY"))

    @contextmanager
    def turn(self, model: str) -> Iterator[None]:
        """Wait until no other service has the turn of the model; uses a connection of its own."""
        with self._turns.connect() as connection:
            _lock(connection, "pg_advisory_xact_lock", TURNS, _key(model))
            yield

    def changes_of_others(self, pause_s: float) -> Iterator[str | None]:
        """Yield the payloads of notices; yield None once it listens, and after each pause, s.

        It uses a connection of its own.
        """
        url = self.engine.url.set(drivername="postgresql").render_as_string(hide_password=False)
        with psycopg.connect(url, autocommit=True, **LISTENER_OPTIONS) as connection:
            connection.execute(f"LISTEN {CHANNEL}")
            while True:
                yield None
                for notice in connection.notifies(timeout=pause_s):
                    yield notice.payload

    def check(self, seconds: float) -> None:
        """Raise an error unless the server answers and can lock for a write of a model within `seconds`.

        It does not wait for other writers of models: a check every second must not delay them.
        """
        with self.engine.connect() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = {max(1, round(1000 * seconds))}"))
            if connection.scalar(text("SELECT pg_is_in_recovery()")):
                raise OSError("the PostgreSQL server is a read-only standby")
            _lock(connection, "pg_advisory_xact_lock_shared", WRITERS, ALL_MODELS)

    def settle(self) -> None:
        """Do nothing: PostgreSQL stops if a sync of its log fails."""

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()
        self._turns.dispose()

    def damage(self) -> list[str]:
        """Return nothing: PostgreSQL checks itself (its checksums, `pg_amcheck`)."""
        return []

    def inconsistencies(self, most: int) -> list[str]:
        """Return nothing: PostgreSQL enforces its references."""
        return []


def _engine(url: str, timeout_s: float, most: int) -> Engine:
    options = OPTIONS | {"lock_timeout": f"{max(1, round(1000 * timeout_s))}ms"}
    made = create_engine(
        _read(url),
        connect_args={
            "options": " ".join(f"-c {name}={value}" for name, value in options.items()),
            "connect_timeout": max(2, round(timeout_s)),
            "application_name": "lipserve",
            **KEEPALIVE_OPTIONS,
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
    """Text without NUL, which PostgreSQL cannot store: a name with NUL is replaced and then not found."""

    def dump(self, obj: str) -> Buffer | None:
        return super().dump(obj.replace("\0", "\ufffd"))


def _configure(connection: psycopg.Connection[Any], _: object) -> None:
    connection.adapters.register_dumper(str, _Text)


def _json(value: Any) -> str:
    """Return JSON for PostgreSQL, with null for NaN and infinities. All other values are read back unchanged."""
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError:
        return json.dumps(json.loads(json.dumps(value), parse_constant=lambda _: None))


def _read(url: str) -> URL:
    try:
        return make_url(url).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError):  # without its own text, which may contain part of the password
        raise ArgumentError(
            "LIPSERVE_DATABASE_URL cannot be read, expected postgresql://user:password@host:port/name; write special "
            "characters of the password as %XX"
        ) from None


def _lock(connection: Connection, function: str, kind: int, key: int) -> None:
    connection.execute(text(f"SELECT {function}(:kind, :key)"), {"kind": kind, "key": key})


def _key(model: str) -> int:
    """Return the lock number of a model, never ALL_MODELS; two models with the same number only wait for each other."""
    return (crc32(model.encode()) & 0x7FFFFFFF) or 1
