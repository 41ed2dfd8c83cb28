"""Snapshots contain nothing that has been unlearnt: one that was stored before goes, and the log is folded again."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"

SNAPSHOTS = sa.table("snapshots", sa.column("model"), sa.column("number"))
EVENTS = sa.table("events", sa.column("model"), sa.column("number"), sa.column("kind"), sa.column("detail", sa.JSON))


def upgrade() -> None:
    """Delete the rows of those snapshots; the learner deletes their files."""
    unlearnt_since = sa.exists().where(
        EVENTS.c.model == SNAPSHOTS.c.model,
        EVENTS.c.kind == "unlearn",
        EVENTS.c.number > SNAPSHOTS.c.number,
        EVENTS.c.detail["event"].as_integer() <= SNAPSHOTS.c.number,
    )
    op.execute(sa.delete(SNAPSHOTS).where(unlearnt_since))
