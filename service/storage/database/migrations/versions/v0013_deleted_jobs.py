"""The jobs that were deleted, by outcome, so that counters of jobs never fall."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Add the table; no earlier release deleted jobs."""
    op.create_table(
        "deleted_jobs",
        sa.Column("outcome", sa.String(16), primary_key=True),
        sa.Column("jobs", BIG, nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("durations", sa.JSON(), nullable=False),
    )
