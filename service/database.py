"""The database: tables and sessions. SQLite in WAL mode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import JSON, ForeignKey, String, create_engine, event, text
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

BUSY_TIMEOUT_MS = 30_000


def now() -> str:
    """Current time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Base(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = {dict[str, Any]: JSON, list[str]: JSON, list[dict[str, str]]: JSON}  # noqa: RUF012 - SQLAlchemy's own form


class DatasetRow(Base):
    """An uploaded data set; its samples lie in the file store under the same id."""

    __tablename__ = "datasets"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    name: Mapped[str]
    created_at: Mapped[str]
    sha256: Mapped[str]
    torque_convention: Mapped[str]
    joint_names: Mapped[list[str]]
    rows: Mapped[int]
    report: Mapped[dict[str, Any]]


class RobotRow(Base):
    """An uploaded URDF with the joints that move."""

    __tablename__ = "robots"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    name: Mapped[str]
    created_at: Mapped[str]
    sha256: Mapped[str]
    joints: Mapped[list[dict[str, str]]]
    urdf: Mapped[str] = mapped_column(deferred=True)  # up to megabytes, which no list needs


class JobRow(Base):
    """A training job: all of its state, written by the service and by the worker."""

    __tablename__ = "jobs"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    model: Mapped[str]
    state: Mapped[str] = mapped_column(index=True)
    request: Mapped[dict[str, Any]]
    progress: Mapped[dict[str, Any]]
    attempts: Mapped[int] = mapped_column(default=0)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    created_at: Mapped[str]
    started_at: Mapped[str | None]
    finished_at: Mapped[str | None]
    heartbeat_at: Mapped[str | None]
    version: Mapped[int | None]
    error: Mapped[dict[str, Any] | None]


class ModelRow(Base):
    """A named model."""

    __tablename__ = "models"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[str]


class VersionRow(Base):
    """An immutable trained version of a model; its files lie in the file store under `folder`."""

    __tablename__ = "versions"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    folder: Mapped[str] = mapped_column(String(40), unique=True)
    created_at: Mapped[str]
    job: Mapped[str | None]
    manifest: Mapped[dict[str, Any]]


class Database:
    """Sessions on one database; safe to share between threads."""

    def __init__(self, home: Path) -> None:
        home.mkdir(parents=True, exist_ok=True)
        self.engine = create_engine(f"sqlite:///{home / 'lipserve.sqlite3'}", connect_args={"timeout": 30})
        event.listen(self.engine, "connect", _configure)
        Base.metadata.create_all(self.engine)
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
    cursor.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
    cursor.close()
