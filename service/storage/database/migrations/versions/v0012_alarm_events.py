"""The events of alarms that wait for the operator's webhook."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

BIG = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Add the table; alarms of earlier releases are not sent."""
    op.create_table(
        "alarm_events",
        sa.Column("seq", BIG, primary_key=True, autoincrement=True),
        sa.Column("at", sa.Double(), nullable=False),
        sa.Column("body", sa.JSON(), nullable=False),
        sa.Column("attempts", BIG, nullable=False),
        sa.Column("due", sa.Double(), nullable=False),
    )
    op.create_index("ix_alarm_events_due", "alarm_events", ["due"])
