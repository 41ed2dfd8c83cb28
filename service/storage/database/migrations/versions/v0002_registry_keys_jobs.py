"""Aliases, API keys, checksums of stored files, what happened to a job, numbers that versions were given."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """Add them; the highest number of a version is that of those there are."""
    op.create_table(
        "api_keys",
        sa.Column("seq", NUMBER, autoincrement=True, nullable=False),
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("hash", sa.String(length=64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created_at", sa.String(), nullable=False),
        sa.Column("expires_at", sa.String(), nullable=True),
        sa.Column("revoked_at", sa.String(), nullable=True),
        sa.Column("used_at", sa.String(), nullable=True),
        sa.PrimaryKeyConstraint("seq"),
        sa.UniqueConstraint("hash"),
        sa.UniqueConstraint("id"),
    )
    op.create_table(
        "alias_moves",
        sa.Column("seq", NUMBER, autoincrement=True, nullable=False),
        sa.Column("model", sa.String(length=64), nullable=False),
        sa.Column("alias", sa.String(length=64), nullable=False),
        sa.Column("version", NUMBER, nullable=True),
        sa.Column("before", NUMBER, nullable=True),
        sa.Column("takes_back", NUMBER, nullable=True),
        sa.Column("at", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["model"],
            ["models.name"],
        ),
        sa.PrimaryKeyConstraint("seq"),
    )
    op.create_index("alias_moves_alias", "alias_moves", ["model", "alias"], unique=False)
    op.create_table(
        "aliases",
        sa.Column("model", sa.String(length=64), nullable=False),
        sa.Column("alias", sa.String(length=64), nullable=False),
        sa.Column("version", NUMBER, nullable=False),
        sa.Column("changed_at", sa.String(), nullable=False),
        sa.ForeignKeyConstraint(
            ["model"],
            ["models.name"],
        ),
        sa.PrimaryKeyConstraint("model", "alias"),
    )
    op.create_table(
        "deleted_models",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("last_version", NUMBER, nullable=False),
        sa.Column("deleted_at", sa.String(), nullable=False),
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
