"""Who changed which model, and which key queued a job; how often a key may ask."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from service.storage.database.migrations import NUMBER, needed, numbered, optional

revision = "0005"
down_revision = "0004"
TEXT, NAME = sa.String(), sa.String(64)
REFUSAL = "the audit log is only added to"


def upgrade() -> None:
    """Add them; of what earlier releases did nothing is known. Lines of the audit log cannot be changed."""
    op.create_table(
        "audit",
        *numbered(),
        *needed(TEXT, "at", "what", "change"),
        *needed(NAME, "model"),
        *optional(sa.String(40), "key"),
        *optional(TEXT, "key_name"),
        *optional(NAME, "request_id", "alias"),
        *optional(NUMBER, "version"),
        *optional(sa.JSON(), "before", "after"),
    )
    op.create_index("audit_model", "audit", ["model", "seq"], unique=False)
    op.add_column("jobs", sa.Column("key", sa.String(length=40), nullable=True))
    op.add_column("api_keys", sa.Column("max_requests_per_s", sa.Double(), nullable=True))
    if op.get_bind().dialect.name == "sqlite":
        op.execute(f"CREATE TRIGGER audit_kept BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END")
        return
    op.execute(
        f"CREATE FUNCTION audit_kept() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN RAISE EXCEPTION '{REFUSAL}'; END $$"
    )
    op.execute("CREATE TRIGGER audit_kept BEFORE UPDATE ON audit FOR EACH ROW EXECUTE FUNCTION audit_kept()")
