"""`lipserve backup` and `lipserve restore`."""

from __future__ import annotations

from pathlib import Path
from sqlite3 import DatabaseError
from typing import Annotated

import typer

from service.cli.consoles import CommandError, print_result
from service.cli.options import Json, alone, settings_of
from service.foundation.settings import Settings
from service.foundation.text import counted
from service.storage.backup import Backup, backup, restore
from service.storage.storage import HomeError

backup_app, restore_app = alone(), alone()
ERRORS = (HomeError, DatabaseError)


@backup_app.command("backup")
def backup_(
    file: Annotated[Path, typer.Argument(help="File to write. It must not exist.")],
    as_json: Json = False,
) -> None:
    """Copy the home LIPSERVE_HOME into one consistent file. Works while the service is running.

    The backup contains everything that was acknowledged before the command started. It contains secrets: protect it
    like the home.
    """
    _print_backup("copied", backup(_own("back up").home, file), as_json)


@restore_app.command("restore")
def restore_(
    file: Annotated[Path, typer.Argument(help="File written by `lipserve backup`.")],
    as_json: Json = False,
) -> None:
    """Restore a backup into the home LIPSERVE_HOME, which must be empty.

    API keys that were revoked after the backup are valid again.
    """
    _print_backup("restored", restore(_own("restore").home, file), as_json)


def _own(action: str) -> Settings:
    """Return the settings; raise CommandError if services share a database and files instead of one home."""
    settings = settings_of()
    if settings.database_url is not None:
        raise CommandError(
            f"cannot {action} a home: LIPSERVE_DATABASE_URL is set, so data are in a shared database and shared files",
            "use pg_dump and pg_restore for PostgreSQL, and bucket versioning (or snapshots of the mounted folder) for "
            "files: docs/scaling.md",
        )
    return settings


def _print_backup(done: str, made: Backup, as_json: bool) -> None:
    print_result(
        made,
        as_json,
        f"{done} {counted(made.datasets, 'data set')}, {counted(made.versions, 'version')}, "
        f"{counted(made.snapshots, 'snapshot')} and {counted(made.observations, 'batch', 'batches')} as of {made.at}, "
        f"{made.size / 1e6:.1f} MB",
    )
