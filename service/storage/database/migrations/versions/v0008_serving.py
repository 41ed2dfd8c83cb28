"""Give each model a row that names its serving version, the newest if none was promoted; that version learns."""

from __future__ import annotations

from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the rows that are missing."""
    op.execute(
        "INSERT INTO serving (model, version, change) SELECT model, MAX(version), 1 FROM versions "
        "WHERE model NOT IN (SELECT model FROM serving) GROUP BY model"
    )
    op.execute(
        "INSERT INTO learners (model, version, start, role) SELECT model, version, 0, 'serving' FROM serving WHERE NOT "
        "EXISTS (SELECT 1 FROM learners WHERE learners.model = serving.model AND learners.version = serving.version)"
    )
