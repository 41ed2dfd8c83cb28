"""The tables of release 0.2.0: the first revision, as no earlier release is upgraded from."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.database.migrations import NUMBER, needed, numbered, of_model, optional

revision = "0004"
down_revision = None
TEXT, ID, NAME, JSON = sa.String(), sa.String(40), sa.String(64), sa.JSON()


def upgrade() -> None:
    """Create all tables."""
    op.create_table(
        "datasets",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "name", "created_at", "sha256", "torque_convention"),
        *needed(JSON, "joint_names", "report"),
        *needed(NUMBER, "rows"),
        *optional(sa.String(100), "idempotency_key"),
        *optional(NAME, "request_digest"),
        sa.UniqueConstraint("id"),
    )
    op.create_index("datasets_idempotency_key", "datasets", ["idempotency_key"], unique=True)
    op.create_table(
        "jobs",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "model", "state", "created_at"),
        *needed(JSON, "request", "progress"),
        *needed(NUMBER, "attempts"),
        *needed(sa.Boolean(), "cancel_requested"),
        *optional(TEXT, "started_at", "finished_at", "heartbeat_at"),
        *optional(NUMBER, "version"),
        *optional(JSON, "error"),
        sa.Column("history", JSON, server_default="[]", nullable=False),
        *optional(ID, "retry_of", "owner"),
        *optional(NAME, "request_id", "request_digest"),
        *optional(sa.String(100), "idempotency_key"),
        sa.UniqueConstraint("id"),
    )
    op.create_index(op.f("ix_jobs_state"), "jobs", ["state"], unique=False)
    op.create_index("jobs_idempotency_key", "jobs", ["idempotency_key"], unique=True)
    op.create_table(
        "models",
        *numbered(),
        *needed(NAME, "name"),
        *needed(TEXT, "created_at"),
        sa.Column("last_version", NUMBER, server_default="0", nullable=False),
        sa.UniqueConstraint("name"),
    )
    op.create_table(
        "deleted_models",
        *needed(NAME, "name"),
        *needed(NUMBER, "last_version"),
        *needed(TEXT, "deleted_at"),
        sa.PrimaryKeyConstraint("name"),
    )
    op.create_table(
        "robots",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "name", "created_at", "sha256", "urdf"),
        *needed(JSON, "joints"),
        sa.UniqueConstraint("id"),
    )
    op.create_table(
        "snapshots",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "model", "created_at"),
        *needed(NUMBER, "version", "number"),
        *optional(TEXT, "sha256"),
        sa.UniqueConstraint("id"),
    )
    op.create_table(
        "alarms", *numbered(), *of_model(), *needed(TEXT, "kind", "at", "message"), *needed(JSON, "evidence")
    )
    op.create_table(
        "events",
        *numbered(),
        *of_model(),
        *needed(NUMBER, "number", "rows", "learnt"),
        *needed(TEXT, "kind"),
        *needed(sa.Double(), "received"),
        *needed(sa.Boolean(), "void"),
        *optional(NAME, "stream_id"),
        *optional(sa.BigInteger(), "sequence", "last_sequence"),
        *optional(TEXT, "digest"),
        *optional(NUMBER, "version", "revision"),
        *optional(sa.Double(), "first", "last"),
        *optional(JSON, "report", "record", "detail"),
        *optional(sa.LargeBinary(), "payload"),
        sa.UniqueConstraint("model", "number"),
        sa.UniqueConstraint("model", "stream_id", "sequence"),
    )
    op.create_index("events_received", "events", ["model", "received"], unique=False)
    op.create_table(
        "learners", *of_model("model", "version"), *needed(NUMBER, "version", "start"), *needed(TEXT, "role")
    )
    op.create_table("learning", *of_model("model"), *needed(JSON, "options"), *optional(JSON, "held"))
    op.create_table("serving", *of_model("model"), *needed(NUMBER, "version", "change"))
    op.create_table(
        "streams",
        *of_model("model", "stream_id"),
        *needed(NAME, "stream_id"),
        *needed(TEXT, "kind", "created_at"),
        *needed(sa.Double(), "offset"),
        *needed(sa.BigInteger(), "last"),
        *needed(JSON, "missing"),
        *optional(sa.BigInteger(), "forgotten"),
    )
    op.create_table(
        "versions",
        *of_model("model", "version"),
        *needed(NUMBER, "version"),
        *needed(ID, "folder"),
        *needed(TEXT, "created_at"),
        *optional(TEXT, "job"),
        *needed(JSON, "manifest"),
        *optional(JSON, "checksums"),
        sa.UniqueConstraint("folder"),
    )
    op.create_table(
        "aliases",
        *of_model("model", "alias"),
        *needed(NAME, "alias"),
        *needed(NUMBER, "version"),
        *needed(TEXT, "changed_at"),
    )
    op.create_table(
        "alias_moves",
        *numbered(),
        *of_model(),
        *needed(NAME, "alias"),
        *optional(NUMBER, "version", "before", "takes_back"),
        *needed(TEXT, "at"),
    )
    op.create_index("alias_moves_alias", "alias_moves", ["model", "alias"], unique=False)
    op.create_table(
        "api_keys",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "name", "created_at"),
        *needed(NAME, "hash"),
        *needed(JSON, "scopes"),
        *optional(TEXT, "expires_at", "revoked_at", "used_at"),
        sa.UniqueConstraint("hash"),
        sa.UniqueConstraint("id"),
    )
    op.create_table(
        "replicas",
        *needed(ID, "id"),
        *needed(TEXT, "host", "started_at"),
        *needed(sa.Double(), "seen_at"),
        sa.PrimaryKeyConstraint("id"),
    )
