"""The database: tables and sessions. SQLite in WAL mode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    UniqueConstraint,
    create_engine,
    event,
    text,
)
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


class ServingRow(Base):
    """Which version of a model answers where none is named: the last that was trained, promoted or rolled back to.

    change: goes up by one whenever that changes. A model without such a row is answered by its newest version.
    """

    __tablename__ = "serving"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int]
    change: Mapped[int]


class LearnerRow(Base):
    """How a version learns: it contains the model's events up to number `start` by training, later ones by updates.

    role: "serving" or, while a refreshed version is compared with the one that serves, "candidate"; "dismissed" where
    that one stayed better. A version without such a row starts at 0.
    """

    __tablename__ = "learners"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    start: Mapped[int]
    role: Mapped[str]


class LearningRow(Base):
    """How a model learns, as its owner has set it, and whether it holds still after a change."""

    __tablename__ = "learning"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    options: Mapped[dict[str, Any]]
    held: Mapped[dict[str, Any] | None]


class StreamRow(Base):
    """A source of observations. Event time = its own time + offset, s.

    kind: "batches" or "frames"; last: highest sequence seen; missing: ranges [first, last] of sequences below it that
    have not come; forgotten: highest sequence whose batch is no longer kept, so that it cannot be known again.
    """

    __tablename__ = "streams"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    stream_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    kind: Mapped[str]
    offset: Mapped[float]
    last: Mapped[int] = mapped_column(BigInteger)
    missing: Mapped[dict[str, Any]]
    forgotten: Mapped[int | None] = mapped_column(BigInteger)
    created_at: Mapped[str]


class EventRow(Base):
    """One entry of a model's log: what came, and what became of it. The posterior is a function of these rows.

    number: 1, 2, 3 … of its model, in the order of commits; kind: "batch", "replay", "unlearn", "rollback", "change" or
    "settings"; sequence, last_sequence: of a batch, and of its last frame; digest: sha256 of what was sent; received:
    Unix time, s; version, revision: that predicted the rows; rows, learnt: how many came and how many teach; first,
    last: event times, s; void: unlearnt or rolled back; report: what the acknowledgement said; record: prequential
    sums; detail: of the other kinds; payload: the rows.
    """

    __tablename__ = "events"
    __table_args__ = (
        UniqueConstraint("model", "number"),
        UniqueConstraint("model", "stream_id", "sequence"),
        Index("events_received", "model", "received"),
    )

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    number: Mapped[int]
    kind: Mapped[str]
    stream_id: Mapped[str | None] = mapped_column(String(64))
    sequence: Mapped[int | None] = mapped_column(BigInteger)
    last_sequence: Mapped[int | None] = mapped_column(BigInteger)
    digest: Mapped[str | None]
    received: Mapped[float]
    version: Mapped[int | None]
    revision: Mapped[int | None]
    rows: Mapped[int] = mapped_column(default=0)
    learnt: Mapped[int] = mapped_column(default=0)
    first: Mapped[float | None]
    last: Mapped[float | None]
    void: Mapped[bool] = mapped_column(default=False)
    report: Mapped[dict[str, Any] | None]
    record: Mapped[dict[str, Any] | None]
    detail: Mapped[dict[str, Any] | None]
    payload: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)  # read only by who needs the rows


class SnapshotRow(Base):
    """What a version had learnt after event `number`; its file lies in the file store under `id`."""

    __tablename__ = "snapshots"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    model: Mapped[str]
    version: Mapped[int]
    number: Mapped[int]
    created_at: Mapped[str]


class AlarmRow(Base):
    """Something about a learning model that its owner should know, with the evidence."""

    __tablename__ = "alarms"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    kind: Mapped[str]
    at: Mapped[str]
    message: Mapped[str]
    evidence: Mapped[dict[str, Any]]


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
