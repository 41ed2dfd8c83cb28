"""Brings a database to the tables of this release: Alembic's revisions, applied when the service starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa

FIRST, HEAD = "0004", "0013"
"""The revision of release 0.2.0, the oldest that is upgraded, and the one that this release needs."""


class DatabaseVersionError(RuntimeError):
    """The database is of a later release, or of one before 0.2.0: this one cannot read it."""


def migrate(engine: sa.Engine, lock: Callable[[sa.Connection, None], None]) -> None:
    """Apply what is missing, all or nothing; a database that is up to date is only looked at.

    lock: begins a transaction as the only writer: other processes wait and then find it done. Raise
    DatabaseVersionError.
    """
    with engine.connect() as connection:
        if revision(connection) == HEAD:
            return
        connection.rollback()
        lock(connection, None)
        known = revision(connection)
        if known != HEAD:
            _upgrade(connection, known)
        connection.commit()


def revision(connection: sa.Connection) -> str | None:
    """Return the revision of a database; None if it is new or from one of the first releases."""
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    number: str | None = connection.scalar(sa.text("SELECT version_num FROM alembic_version"))
    return number


def _upgrade(connection: sa.Connection, prior: str | None) -> None:
    from alembic import command  # noqa: PLC0415 - needed once a release, by none of the processes that train or learn
    from alembic.config import Config  # noqa: PLC0415
    from alembic.script import ScriptDirectory  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    config.attributes["connection"] = connection
    if prior < FIRST if prior else sa.inspect(connection).has_table("models"):
        raise DatabaseVersionError(
            "the database is older than release 0.2.0: start that release on it once (pip install 'lipserve==0.2.0'), "
            "then this one"
        )
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    if prior is not None and prior not in known:
        raise DatabaseVersionError(
            f"the database has revision {prior!r}, expected at most {HEAD!r}: a later release of LIPServe has used it. "
            "Start that release, or set LIPSERVE_HOME or LIPSERVE_DATABASE_URL to another database"
        )
    if prior == FIRST:
        _check_contents(connection)
    command.upgrade(config, HEAD)


KEPT: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "datasets": ("id", "report", ("timing", "advice")),
    "versions": ("folder", "manifest", ("parameters", "warnings", "hyperparameters")),
}
"""Tables of which release 0.2.0 has kept rows of 0.1: what names a row, and entries of its JSON that these lack."""


def _check_contents(connection: sa.Connection) -> None:
    """Raise DatabaseVersionError for data sets and versions that release 0.1 has made."""
    for table, (name, document, entries) in KEPT.items():
        rows = sa.table(table, sa.column(name), sa.column(document, sa.JSON))
        lacking = sa.or_(*(rows.c[document][entry].as_string().is_(None) for entry in entries))
        if older := list(connection.scalars(sa.select(rows.c[name]).where(lacking))):
            raise DatabaseVersionError(
                f"{len(older)} of the {table} were made by a release before 0.2.0, which this one does not read: start "
                f"release 0.2.0, delete them there, and upload or train them again ({', '.join(older[:5])})"
            )


NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def needed(kind: Any, *names: str) -> Iterator[sa.Column[Any]]:
    """Columns of one type that no row goes without."""
    return (sa.Column(name, kind, nullable=False) for name in names)


def optional(kind: Any, *names: str) -> Iterator[sa.Column[Any]]:
    """Columns of one type that may be null."""
    return (sa.Column(name, kind, nullable=True) for name in names)


def numbered() -> list[Any]:
    """Column and primary key of a table with counted rows."""
    return [sa.Column("seq", NUMBER, autoincrement=True, nullable=False), sa.PrimaryKeyConstraint("seq")]


def of_model(*key: str) -> list[Any]:
    """Column of the model that rows belong to; key: primary key, where it is one."""
    columns: list[Any] = [
        sa.Column("model", sa.String(64), nullable=False),
        sa.ForeignKeyConstraint(["model"], ["models.name"]),
    ]
    return [*columns, sa.PrimaryKeyConstraint(*key)] if key else columns
