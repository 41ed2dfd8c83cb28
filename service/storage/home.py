"""The home folder belongs to one running service at a time, and has to be whole before one starts on it."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sqlalchemy.exc import SQLAlchemyError

from service.foundation.settings import Settings
from service.storage.database.engine import FILE, Database, DriverMissingError
from service.storage.database.migrations import DatabaseVersionError
from service.storage.files import Files, FilesUnreachableError


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
    home = settings.home
    with hold_home(home), usable(settings):
        try:
            files = Files.of(settings)
            files.upload().unlink()
            files.try_out()
        except FilesUnreachableError:
            raise
        except OSError as error:
            raise HomeError(_unusable(home, error)) from error
        damage = _damage(settings)
    if damage is not None:
        raise HomeError(_unusable_database(settings, damage))


@contextmanager
def usable(settings: Settings) -> Iterator[None]:
    """Raise HomeError, which says what would help, for what keeps a block from using the database or shared files."""
    try:
        yield
    except (DatabaseVersionError, DriverMissingError) as error:
        raise HomeError(str(error)) from error
    except FilesUnreachableError as error:
        raise HomeError(_unusable_files(settings, error)) from error
    except SQLAlchemyError as error:
        raise HomeError(_unusable_database(settings, str(getattr(error, "orig", None) or error))) from error


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


def _unusable_files(settings: Settings, error: OSError) -> str:
    expected = "a folder that is mounted and that the service may write to"
    if (settings.files_url or "").startswith("s3:"):
        expected = "a bucket that this service may list, read, write and delete in, by the AWS_ variables or a role"
    return f"files_url is {settings.files_url!r}, expected {expected}: {error.strerror or error}"


def _unusable_database(settings: Settings, damage: str) -> str:
    if settings.database_url is not None:
        return f"the database of LIPSERVE_DATABASE_URL cannot be used: {damage}"
    path = settings.home / FILE
    return (
        f"the database {path} cannot be used: {damage}. Where it is damaged, restore a copy of the home, or what "
        f'can be read of it with `sqlite3 {path} ".recover"`; or set LIPSERVE_HOME to another folder'
    )
