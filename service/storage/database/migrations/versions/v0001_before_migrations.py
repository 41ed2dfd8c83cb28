"""The tables of the releases before there were migrations; those that are there already stay as they are."""

from __future__ import annotations

from functools import partial

import sqlalchemy as sa
from alembic import op

from service.storage.database.migrations import NUMBER, needed, numbered, of_model, optional

revision = "0001"
down_revision = None
TEXT, ID, NAME, JSON = sa.String(), sa.String(40), sa.String(64), sa.JSON()


def upgrade() -> None:
    """Create what is missing."""
    table = partial(op.create_table, if_not_exists=True)
    table(
        "datasets",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "name", "created_at", "sha256", "torque_convention"),
        *needed(JSON, "joint_names", "report"),
        *needed(NUMBER, "rows"),
        sa.UniqueConstraint("id"),
    )
    table(
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
        sa.UniqueConstraint("id"),
    )
    op.create_index(op.f("ix_jobs_state"), "jobs", ["state"], unique=False, if_not_exists=True)
    table("models", *numbered(), *needed(NAME, "name"), *needed(TEXT, "created_at"), sa.UniqueConstraint("name"))
    table(
        "robots",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "name", "created_at", "sha256", "urdf"),
        *needed(JSON, "joints"),
        sa.UniqueConstraint("id"),
    )
    table(
        "snapshots",
        *numbered(),
        *needed(ID, "id"),
        *needed(TEXT, "model", "created_at"),
        *needed(NUMBER, "version", "number"),
        sa.UniqueConstraint("id"),
    )
    table("alarms", *numbered(), *of_model(), *needed(TEXT, "kind", "at", "message"), *needed(JSON, "evidence"))
    table(
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
    op.create_index("events_received", "events", ["model", "received"], unique=False, if_not_exists=True)
    table("learners", *of_model("model", "version"), *needed(NUMBER, "version", "start"), *needed(TEXT, "role"))
    table("learning", *of_model("model"), *needed(JSON, "options"), *optional(JSON, "held"))
    table("serving", *of_model("model"), *needed(NUMBER, "version", "change"))
    table(
        "streams",
        *of_model("model", "stream_id"),
        *needed(NAME, "stream_id"),
        *needed(TEXT, "kind", "created_at"),
        *needed(sa.Double(), "offset"),
        *needed(sa.BigInteger(), "last"),
        *needed(JSON, "missing"),
        *optional(sa.BigInteger(), "forgotten"),
    )
    table(
        "versions",
        *of_model("model", "version"),
        *needed(NUMBER, "version"),
        *needed(ID, "folder"),
        *needed(TEXT, "created_at"),
        *optional(TEXT, "job"),
        *needed(JSON, "manifest"),
        sa.UniqueConstraint("folder"),
    )
