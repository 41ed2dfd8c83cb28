"""The tables of the database."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, LargeBinary, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


def now() -> str:
    """Current time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class Base(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's own form
        # a fleet writes 2**31 batches in weeks; SQLite's INTEGER has as many digits, and numbers rows only so
        int: BigInteger().with_variant(Integer(), "sqlite"),
        dict[str, Any]: JSON,
        list[str]: JSON,
        list[dict[str, str]]: JSON,
        list[dict[str, Any]]: JSON,
    }


class DatasetRow(Base):
    """An uploaded data set; its samples lie in the file store under the same id.

    idempotency_key, request_digest: see `service.storage.rows`; None where the client has given none.
    """

    __tablename__ = "datasets"
    __table_args__ = (Index("datasets_idempotency_key", "idempotency_key", unique=True),)

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    name: Mapped[str]
    created_at: Mapped[str]
    sha256: Mapped[str]
    torque_convention: Mapped[str]
    joint_names: Mapped[list[str]]
    rows: Mapped[int]
    report: Mapped[dict[str, Any]]
    idempotency_key: Mapped[str | None] = mapped_column(String(100))
    request_digest: Mapped[str | None] = mapped_column(String(64))


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
    """A training job: all of its state, written by the service and by the worker.

    history: what happened to it, oldest first, each {at, state, message}; retry_of: id of the job that it repeats;
    request_id: of the request that queued it; owner: id of the service that has it run, None where none does yet;
    idempotency_key, request_digest: `service.storage.rows`; key: id of the API key that queued it, None without keys.
    """

    __tablename__ = "jobs"
    __table_args__ = (Index("jobs_idempotency_key", "idempotency_key", unique=True),)

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
    history: Mapped[list[dict[str, Any]]] = mapped_column(default=list, server_default="[]")
    retry_of: Mapped[str | None] = mapped_column(String(40))
    request_id: Mapped[str | None] = mapped_column(String(64))
    owner: Mapped[str | None] = mapped_column(String(40))
    idempotency_key: Mapped[str | None] = mapped_column(String(100))
    request_digest: Mapped[str | None] = mapped_column(String(64))
    key: Mapped[str | None] = mapped_column(String(40))


class ReplicaRow(Base):
    """A service that shares the database with others. seen_at: its last sign of life, Unix s (database's clock)."""

    __tablename__ = "replicas"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    host: Mapped[str]
    started_at: Mapped[str]
    seen_at: Mapped[float]


class ModelRow(Base):
    """A named model. last_version: the highest number that a version of it was ever given; none is given twice."""

    __tablename__ = "models"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[str]
    last_version: Mapped[int] = mapped_column(default=0, server_default="0")


class DeletedModelRow(Base):
    """A model that was deleted: one of the same name goes on with the numbers after `last_version`."""

    __tablename__ = "deleted_models"

    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    last_version: Mapped[int]
    deleted_at: Mapped[str]


class VersionRow(Base):
    """An immutable trained version of a model; its files lie in the file store under `folder`.

    checksums: sha256 of each of these files by name, None of versions from before they were kept.
    """

    __tablename__ = "versions"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    folder: Mapped[str] = mapped_column(String(40), unique=True)
    created_at: Mapped[str]
    job: Mapped[str | None]
    manifest: Mapped[dict[str, Any]]
    checksums: Mapped[dict[str, Any] | None]


class AliasRow(Base):
    """A name that the owner of a model has given to one of its versions, and may move to another one."""

    __tablename__ = "aliases"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    alias: Mapped[str] = mapped_column(String(64), primary_key=True)
    version: Mapped[int]
    changed_at: Mapped[str]


class AliasMoveRow(Base):
    """One move of an alias, so that it can be taken back. version: where to, None where it was removed; before: where
    from, None where it was new; takes_back: `seq` of the move that this one has taken back."""

    __tablename__ = "alias_moves"
    __table_args__ = (Index("alias_moves_alias", "model", "alias"),)

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    alias: Mapped[str] = mapped_column(String(64))
    version: Mapped[int | None]
    before: Mapped[int | None]
    takes_back: Mapped[int | None]
    at: Mapped[str]


class ServingRow(Base):
    """Which version of a model answers where none is named: the last that was trained, promoted or rolled back to. None
    does of a model without such a row: all of its versions are candidates.

    change: goes up by one whenever that changes.
    """

    __tablename__ = "serving"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int]
    change: Mapped[int]


class LearnerRow(Base):
    """How a version learns: it contains the model's events up to number `start` by training, later ones by updates.

    role: "serving", or "dismissed" for one that does not learn. A version without such a row starts at 0.
    """

    __tablename__ = "learners"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    start: Mapped[int]
    role: Mapped[str]


class LearningRow(Base):
    """How a model learns, as its owner has set it, whether it holds still after a change, and the payload that was
    declared for all of its streams (see `lipcore.online.stream.PayloadRecord`)."""

    __tablename__ = "learning"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    options: Mapped[dict[str, Any]]
    held: Mapped[dict[str, Any] | None]
    payload: Mapped[dict[str, Any] | None]


class StreamRow(Base):
    """A source of observations. Event time = its own time + offset, s.

    kind: "batches" or "frames"; last: highest sequence seen; missing: ranges [first, last] of sequences below it that
    have not come; forgotten: highest sequence whose batch is no longer kept, so that it cannot be known again;
    received: when the last one came, Unix time, s; record: see `lipcore.online.stream.StreamRecord`; both are None
    for what an earlier release has written.
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
    received: Mapped[float | None]
    record: Mapped[dict[str, Any] | None] = mapped_column(deferred=True)  # written with each batch, but rarely read


class EventRow(Base):
    """One entry of a model's log: what came, and what became of it. The posterior is a function of these rows.

    number: 1, 2, 3 … of its model, in the order of commits; kind: "batch", "replay", "unlearn", "rollback", "change" or
    "settings"; sequence, last_sequence: of a batch, and of its last frame; digest: sha256 of what was sent; received:
    Unix time, s; clock: that of the model's own clock, see `service.journal.log.clock`, None where an earlier release
    has logged it; version, revision: that predicted the rows; rows, learnt: how many came and how many teach; first,
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
    clock: Mapped[float | None]
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
    sha256: Mapped[str | None]


class AlarmRow(Base):
    """Something about a learning model that its owner should know, with the evidence."""

    __tablename__ = "alarms"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    kind: Mapped[str]
    at: Mapped[str]
    message: Mapped[str]
    evidence: Mapped[dict[str, Any]]


class ApiKeyRow(Base):
    """An API key: what it may do and until when. The key itself is not kept.

    id: shown in lists and logs; hash: sha256 of the key; scopes: see `web.access.scopes`; expires_at, revoked_at:
    None where it never does, or has not been; used_at: when it was seen last, to about a minute; max_requests_per_s:
    None where the setting of this name holds.
    """

    __tablename__ = "api_keys"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    name: Mapped[str]
    hash: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[str]]
    created_at: Mapped[str]
    expires_at: Mapped[str | None]
    revoked_at: Mapped[str | None]
    used_at: Mapped[str | None]
    max_requests_per_s: Mapped[float | None]


class AuditRow(Base):
    """One change of a model, see `service.storage.audit`. No line refers to a model's row: it outlives that.

    key, key_name: API key of who did it, None without keys; what: method and route, or `job` and its id, or `service`;
    before, after: what was and what is, as JSON. The database refuses to change a line.
    """

    __tablename__ = "audit"
    __table_args__ = (Index("audit_model", "model", "seq"),)

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[str]
    key: Mapped[str | None] = mapped_column(String(40))
    key_name: Mapped[str | None]
    what: Mapped[str]
    request_id: Mapped[str | None] = mapped_column(String(64))
    model: Mapped[str] = mapped_column(String(64))
    change: Mapped[str]
    version: Mapped[int | None]
    alias: Mapped[str | None] = mapped_column(String(64))
    before: Mapped[Any | None] = mapped_column(JSON)
    after: Mapped[Any | None] = mapped_column(JSON)
