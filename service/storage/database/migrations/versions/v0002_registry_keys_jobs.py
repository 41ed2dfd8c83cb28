"""Aliases, API keys, checksums of stored files, what happened to a job, numbers that versions were given."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.database.migrations import NUMBER, needed, numbered, of_model, optional

revision = "0002"
down_revision = "0001"
TEXT, NAME = sa.String(), sa.String(64)


def upgrade() -> None:
    """Add them; the highest number of a version is that of those there are."""
    op.create_table(
        "api_keys",
        *numbered(),
        *needed(sa.String(40), "id"),
        *needed(TEXT, "name", "created_at"),
        *needed(NAME, "hash"),
        *needed(sa.JSON(), "scopes"),
        *optional(TEXT, "expires_at", "revoked_at", "used_at"),
        sa.UniqueConstraint("hash"),
        sa.UniqueConstraint("id"),
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
        "aliases",
        *of_model("model", "alias"),
        *needed(NAME, "alias"),
        *needed(NUMBER, "version"),
        *needed(TEXT, "changed_at"),
    )
    op.create_table(
        "deleted_models",
        *needed(NAME, "name"),
        *needed(NUMBER, "last_version"),
        *needed(TEXT, "deleted_at"),
        sa.PrimaryKeyConstraint("name"),
    )
    op.add_column("jobs", sa.Column("history", sa.JSON(), server_default="[]", nullable=False))
    op.add_column("jobs", sa.Column("retry_of", sa.String(length=40), nullable=True))
    op.add_column("jobs", sa.Column("request_id", sa.String(length=64), nullable=True))
    op.add_column("models", sa.Column("last_version", NUMBER, server_default="0", nullable=False))
    op.add_column("snapshots", sa.Column("sha256", sa.String(), nullable=True))
    op.add_column("versions", sa.Column("checksums", sa.JSON(), nullable=True))
    op.execute(
        "UPDATE models SET last_version = "
        "COALESCE((SELECT MAX(version) FROM versions WHERE versions.model = models.name), 0)"
    )
