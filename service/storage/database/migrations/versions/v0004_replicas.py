"""Services that share a database, and which of them has a job run."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.database.migrations import needed

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add them; jobs of earlier releases have no owner."""
    op.create_table(
        "replicas",
        *needed(sa.String(40), "id"),
        *needed(sa.String(), "host", "started_at"),
        *needed(sa.Double(), "seen_at"),
        sa.PrimaryKeyConstraint("id"),
    )
    op.add_column("jobs", sa.Column("owner", sa.String(length=40), nullable=True))
