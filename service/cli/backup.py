"""`lipserve backup` and `lipserve restore`: a home in one file, taken while a service runs on it, and back."""

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
    file: Annotated[Path, typer.Argument(help="File to write, a new one.")],
    as_json: Json = False,
) -> None:
    """Copy the home LIPSERVE_HOME into one file, as of one moment; also while the service runs.

    All that was acknowledged before the command began is in it. Keep it as secret as the home.
    """
    _say("copied", backup(_own("back up").home, file), as_json)


@restore_app.command("restore")
def restore_(
    file: Annotated[Path, typer.Argument(help="File that `lipserve backup` has written.")],
    as_json: Json = False,
) -> None:
    """Make the home LIPSERVE_HOME, which has to be empty, of a backup. API keys revoked since are valid again."""
    _say("restored", restore(_own("restore").home, file), as_json)


def _own(what: str) -> Settings:
    """Settings of a home that holds everything; raise CommandError where it shares a database and files."""
    settings = settings_of()
    if settings.database_url is not None:
        raise CommandError(
            f"LIPSERVE_DATABASE_URL is set: there is no home to {what}, but a database and files that services share",
            "use pg_dump and pg_restore for PostgreSQL, and versioning of the bucket (or snapshots of the mounted "
            "folder) for files: docs/scaling.md",
        )
    return settings


def _say(done: str, made: Backup, as_json: bool) -> None:
    print_result(
        made,
        as_json,
        f"{done} {counted(made.datasets, 'data set')}, {counted(made.versions, 'version')}, "
        f"{counted(made.snapshots, 'snapshot')} and {counted(made.observations, 'batch', 'batches')} as of {made.at}, "
        f"{made.size / 1e6:.1f} MB",
    )
