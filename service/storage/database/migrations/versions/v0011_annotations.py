"""The note and the tags of a version."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add them; versions of earlier releases have none."""
    op.add_column("versions", sa.Column("note", sa.String(), nullable=True))
    op.add_column("versions", sa.Column("tags", sa.JSON(), nullable=True))
