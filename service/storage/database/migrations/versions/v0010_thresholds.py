"""Thresholds of the verdicts on the versions of a model."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Add them; models of earlier releases have the defaults."""
    op.add_column("models", sa.Column("thresholds", sa.JSON(), nullable=True))
