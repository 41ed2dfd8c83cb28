"""The home folder belongs to one running service at a time, and has to be whole before one starts on it."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO

from sqlalchemy.exc import SQLAlchemyError

from service.database.engine import Database
from service.database.migrations import DatabaseVersionError
from service.database.sqlite import FILE
from service.files import Files
from service.settings import Settings


class HomeError(RuntimeError):
    """No service can start on the home; the message says why and what would help."""


class HomeInUseError(HomeError):
    """Another service works on the same home."""


def hold_home(home: Path) -> IO[str]:
    """Hold the home for this process; the lock ends with the process, however it ends. Raise HomeError."""
    try:
        home.mkdir(parents=True, exist_ok=True)
        file = (home / ".lock").open("w")
    except OSError as error:
        raise HomeError(_unusable(home, error)) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise HomeInUseError(f"another service uses {home}: stop it, or set LIPSERVE_HOME to another folder") from None
    return file


def check_home(settings: Settings) -> None:
    """See that a service can start: the home is nobody else's and can be written, its database is whole and up to date.

    Takes about 0.3 s for each GB of the database. Raise HomeError.
    """
    home, path = settings.home, settings.home / FILE
    with hold_home(home):
        try:
            Files.of(settings).upload().unlink()
        except OSError as error:
            raise HomeError(_unusable(home, error)) from error
        try:
            found = _damage(settings)
        except DatabaseVersionError as error:
            raise HomeError(str(error)) from error
        except SQLAlchemyError as error:
            found = str(getattr(error, "orig", error))
    if found is not None:
        raise HomeError(
            f"the database {path} cannot be used: {found}. Where it is damaged, restore a copy of the home, or what "
            f'can be read of it with `sqlite3 {path} ".recover"`; or set LIPSERVE_HOME to another folder'
        )


def _damage(settings: Settings) -> str | None:
    """What is wrong with the database, None where it is whole."""
    database = Database.of(settings, settings.database_timeout_s)
    try:
        with database.transaction():  # a database that can only be read is of no use either
            pass
        return next(iter(database.adapter.damage()), None)
    finally:
        database.close()


def _unusable(home: Path, error: OSError) -> str:
    return f"home is {str(home)!r}, expected a folder that the service may write to: {error.strerror or error}"
