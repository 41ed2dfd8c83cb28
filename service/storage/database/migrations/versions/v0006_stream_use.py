"""When a stream was used last, so that those that are silent for longest can make room for others."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add it; of streams of earlier releases it is not known."""
    op.add_column("streams", sa.Column("received", sa.Double(), nullable=True))
