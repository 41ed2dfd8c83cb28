"""What Alembic runs for every command: on the connection that it is given, inside its transaction."""

from __future__ import annotations

from alembic import context

from service.storage.database.tables import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
context.run_migrations()
