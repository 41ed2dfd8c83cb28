"""Names that clients give to requests which make a data set or a job, so that they can be sent again."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the keys and the digests of the requests; rows of earlier releases have none."""
    for table in ("datasets", "jobs"):
        op.add_column(table, sa.Column("idempotency_key", sa.String(length=100), nullable=True))
        op.add_column(table, sa.Column("request_digest", sa.String(length=64), nullable=True))
        op.create_index(f"{table}_idempotency_key", table, ["idempotency_key"], unique=True)
