"""The tables of the database."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, LargeBinary, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Base(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's own form
        # a fleet writes 2**31 batches in weeks; SQLite's INTEGER is as large, and auto-increments only as such
        int: BigInteger().with_variant(Integer(), "sqlite"),
        dict[str, Any]: JSON,
        list[str]: JSON,
        list[dict[str, str]]: JSON,
        list[dict[str, Any]]: JSON,
    }


class DatasetRow(Base):
    """An uploaded data set; the file store keeps its samples under the same id."""

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
    """This and `request_digest`: see `service.storage.rows`; None if the client sent no key."""
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
    """A training job with its whole state, written by the service and by the worker."""

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
    """Events of the job as {at, state, message}, oldest first."""
    retry_of: Mapped[str | None] = mapped_column(String(40))
    """Id of the job that this one repeats."""
    request_id: Mapped[str | None] = mapped_column(String(64))
    """Id of the request that queued it."""
    owner: Mapped[str | None] = mapped_column(String(40))
    """Id of the service that runs it, None if there is none yet."""
    idempotency_key: Mapped[str | None] = mapped_column(String(100))
    """This and `request_digest`: see `service.storage.rows`; None if the client sent no key."""
    request_digest: Mapped[str | None] = mapped_column(String(64))
    key: Mapped[str | None] = mapped_column(String(40))
    """Id of the API key that queued it, None without keys."""


class DeletedJobsRow(Base):
    """The deleted jobs of an outcome, so that counters of jobs never fall."""

    __tablename__ = "deleted_jobs"

    outcome: Mapped[str] = mapped_column(String(16), primary_key=True)
    jobs: Mapped[int]
    seconds: Mapped[float]
    """Sum of their durations, s."""
    durations: Mapped[list[int]] = mapped_column(JSON)
    """Number of jobs by duration, see `service.training.ended`."""


class ReplicaRow(Base):
    """A service that shares the database with others."""

    __tablename__ = "replicas"

    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    host: Mapped[str]
    started_at: Mapped[str]
    seen_at: Mapped[float]
    """Time of its last heartbeat by the database's clock, Unix s."""


class ModelRow(Base):
    """A named model."""

    __tablename__ = "models"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[str]
    last_version: Mapped[int] = mapped_column(default=0, server_default="0")
    """Highest version number given so far; no number is given twice."""
    thresholds: Mapped[dict[str, Any] | None] = mapped_column(JSON, default=None)
    """Thresholds of the verdicts on its versions, see `Thresholds`; None for the defaults."""


class DeletedModelRow(Base):
    """A deleted model: a new one of the same name continues with the numbers after `last_version`."""

    __tablename__ = "deleted_models"

    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    last_version: Mapped[int]
    deleted_at: Mapped[str]


class VersionRow(Base):
    """A trained version of a model; the file store keeps its files under `folder`. Only `note` and `tags` change."""

    __tablename__ = "versions"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    folder: Mapped[str] = mapped_column(String(40), unique=True)
    created_at: Mapped[str]
    job: Mapped[str | None]
    manifest: Mapped[dict[str, Any]]
    checksums: Mapped[dict[str, Any] | None]
    """sha256 of each file by name; None for versions stored before checksums existed."""
    note: Mapped[str | None] = mapped_column(default=None)
    tags: Mapped[list[str] | None] = mapped_column(JSON, default=None)


class AliasRow(Base):
    """A name that the owner of a model gave to one of its versions, and may move to another one."""

    __tablename__ = "aliases"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    alias: Mapped[str] = mapped_column(String(64), primary_key=True)
    version: Mapped[int]
    changed_at: Mapped[str]


class AliasMoveRow(Base):
    """One move of an alias, so that it can be undone."""

    __tablename__ = "alias_moves"
    __table_args__ = (Index("alias_moves_alias", "model", "alias"),)

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    alias: Mapped[str] = mapped_column(String(64))
    version: Mapped[int | None]
    """New target; None if the alias was removed."""
    before: Mapped[int | None]
    """Old target; None if the alias was new."""
    takes_back: Mapped[int | None]
    """`seq` of the move that this one undid."""
    at: Mapped[str]


class ServingRow(Base):
    """The serving version of a model: the last that was trained, promoted or rolled back to.

    A model without such a row has no serving version: all of its versions are candidates.
    """

    __tablename__ = "serving"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int]
    change: Mapped[int]
    """Number of changes of the serving version."""


class LearnerRow(Base):
    """State of a version's learning: training used the events up to number `start`, online updates the later ones.

    A version without such a row starts at 0.
    """

    __tablename__ = "learners"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    start: Mapped[int]
    role: Mapped[str]
    """`serving`, or `dismissed` for a version that does not learn."""


class LearningRow(Base):
    """Learning settings of a model."""

    __tablename__ = "learning"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    options: Mapped[dict[str, Any]]
    """Options that the owner set."""
    held: Mapped[dict[str, Any] | None]
    """Why learning is paused after a change, None if it is not."""
    payload: Mapped[dict[str, Any] | None]
    """Payload declared for all of its streams, see `lipcore.online.stream.PayloadRecord`."""


class StreamRow(Base):
    """A stream of observations. Event time = its own time + offset, s."""

    __tablename__ = "streams"

    model: Mapped[str] = mapped_column(ForeignKey("models.name"), primary_key=True)
    stream_id: Mapped[str] = mapped_column(String(64), primary_key=True)
    kind: Mapped[str]
    """`batches` or `frames`."""
    offset: Mapped[float]
    last: Mapped[int] = mapped_column(BigInteger)
    """Highest sequence number received."""
    missing: Mapped[dict[str, Any]]
    """Ranges [first, last] of missing sequence numbers below `last`."""
    forgotten: Mapped[int | None] = mapped_column(BigInteger)
    """Highest sequence number of a deleted batch, so that a repetition is not recognised."""
    created_at: Mapped[str]
    received: Mapped[float | None]
    """Time of the last batch, Unix s; None for rows of earlier releases."""
    record: Mapped[dict[str, Any] | None] = mapped_column(deferred=True)  # written with each batch, but rarely read
    """See `lipcore.online.stream.StreamRecord`; None for rows of earlier releases."""


class EventRow(Base):
    """One event of a model's log: an input and its effect. The posterior is a function of these rows."""

    __tablename__ = "events"
    __table_args__ = (
        UniqueConstraint("model", "number"),
        UniqueConstraint("model", "stream_id", "sequence"),
        Index("events_received", "model", "received"),
    )

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    number: Mapped[int]
    """1, 2, 3 … per model, in the order of commits."""
    kind: Mapped[str]
    """`batch`, `replay`, `unlearn`, `rollback`, `change` or `settings`."""
    stream_id: Mapped[str | None] = mapped_column(String(64))
    sequence: Mapped[int | None] = mapped_column(BigInteger)
    """Sequence number of a batch."""
    last_sequence: Mapped[int | None] = mapped_column(BigInteger)
    """Sequence number of a batch's last frame."""
    digest: Mapped[str | None]
    """sha256 of the sent batch."""
    received: Mapped[float]
    """Unix time, s."""
    clock: Mapped[float | None]
    """Time of the model's own clock, see `service.journal.log.clock`; None for events of earlier releases."""
    version: Mapped[int | None]
    """Version that predicted the rows."""
    revision: Mapped[int | None]
    """Revision that predicted the rows."""
    rows: Mapped[int] = mapped_column(default=0)
    """Number of received rows."""
    learnt: Mapped[int] = mapped_column(default=0)
    """Number of learnt rows."""
    first: Mapped[float | None]
    """Event time of the first row, s."""
    last: Mapped[float | None]
    """Event time of the last row, s."""
    void: Mapped[bool] = mapped_column(default=False)
    """Whether it was unlearnt or rolled back."""
    report: Mapped[dict[str, Any] | None]
    """Content of the acknowledgement."""
    record: Mapped[dict[str, Any] | None]
    """Prequential sums."""
    detail: Mapped[dict[str, Any] | None]
    """Content of an event that is no batch."""
    payload: Mapped[bytes | None] = mapped_column(LargeBinary, deferred=True)  # most readers do not need the rows
    """The rows."""


class SnapshotRow(Base):
    """The learnt state of a version after event `number`; the file store keeps its file under `id`."""

    __tablename__ = "snapshots"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    model: Mapped[str]
    version: Mapped[int]
    number: Mapped[int]
    created_at: Mapped[str]
    sha256: Mapped[str | None]


class AlarmRow(Base):
    """An alarm of a learning model for its owner, with the evidence."""

    __tablename__ = "alarms"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    model: Mapped[str] = mapped_column(ForeignKey("models.name"))
    kind: Mapped[str]
    at: Mapped[str]
    message: Mapped[str]
    evidence: Mapped[dict[str, Any]]


class AlarmEventRow(Base):
    """An alarm raised or cleared that the webhook of the operator has not acknowledged yet."""

    __tablename__ = "alarm_events"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[float]
    """Unix time, s."""
    body: Mapped[dict[str, Any]]
    """The JSON that is sent."""
    attempts: Mapped[int] = mapped_column(default=0)
    due: Mapped[float] = mapped_column(index=True)
    """Unix time of the next attempt, s."""


class ApiKeyRow(Base):
    """An API key with its scopes and expiry. The key itself is not stored."""

    __tablename__ = "api_keys"

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(40), unique=True)
    """Shown in lists and logs."""
    name: Mapped[str]
    hash: Mapped[str] = mapped_column(String(64), unique=True)
    """sha256 of the key."""
    scopes: Mapped[list[str]]
    """See `service.api.access.scopes`."""
    created_at: Mapped[str]
    expires_at: Mapped[str | None]
    """None if it never expires."""
    revoked_at: Mapped[str | None]
    """None if it is not revoked."""
    used_at: Mapped[str | None]
    """Time of its last use, to about a minute."""
    max_requests_per_s: Mapped[float | None]
    """None if the setting of this name applies."""


class AuditRow(Base):
    """One change of a model, see `service.storage.audit`.

    A line does not refer to the row of the model, because it outlives that row. The database rejects changes of a line.
    """

    __tablename__ = "audit"
    __table_args__ = (Index("audit_model", "model", "seq"),)

    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[str]
    key: Mapped[str | None] = mapped_column(String(40))
    """Id of the API key of the request, None without keys."""
    key_name: Mapped[str | None]
    """Name of that key."""
    what: Mapped[str]
    """Method and route; `job` and its id; or `service`."""
    request_id: Mapped[str | None] = mapped_column(String(64))
    model: Mapped[str] = mapped_column(String(64))
    change: Mapped[str]
    version: Mapped[int | None]
    alias: Mapped[str | None] = mapped_column(String(64))
    before: Mapped[Any | None] = mapped_column(JSON)
    """JSON before the change."""
    after: Mapped[Any | None] = mapped_column(JSON)
    """JSON after the change."""
