"""What a service keeps things in: a database, a store of files, a disk, a home folder; how these are. The home belongs
to one running service at a time, and has to be whole before one starts on it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from lipcore.extras import MissingExtraError
from lipcore.files.durable import make_folder
from service.contract.states import PartState
from service.foundation.settings import Settings
from service.storage.database.engine import FILE, Database
from service.storage.database.migrations import DatabaseVersionError
from service.storage.disk import Disk
from service.storage.files import Files, FilesUnreachableError
from service.telemetry.readiness import Lasting, Look

WAIT_S = 10.0
"""Longest wait in s of a request for another writer of the database; then it gets a 503."""


@dataclass(frozen=True)
class Storage:
    """The storage of a running service, and the limits of what is put there."""

    settings: Settings
    database: Database
    files: Files
    disk: Disk

    @classmethod
    def open(cls, settings: Settings) -> Storage:
        """Open, or make, what the settings name."""
        return cls(settings, Database.of(settings, WAIT_S), Files.of(settings), Disk(settings))

    def looks(self) -> dict[str, Look]:
        """How readiness looks at each part, by its name."""
        parts = {"database": look_database, "home": look_home} | ({"files": look_files} if self.files.shared else {})
        return {name: partial(look, self) for name, look in parts.items()}


WRITE_S = 2.0
"""Longest wait in s for another writer of the database: commits take milliseconds."""


def look_database(storage: Storage, _: Lasting) -> tuple[PartState, str]:
    """Whether the database answers, and can be written in time."""
    with storage.database.session() as session:
        session.execute(text("SELECT 1"))
    storage.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def look_home(storage: Storage, _: Lasting) -> tuple[PartState, str]:
    """Whether the home can be written, and has room."""
    path = storage.files.upload()
    try:
        path.write_bytes(bytes(4096))
    finally:
        path.unlink(missing_ok=True)
    shortage = storage.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def look_files(storage: Storage, _: Lasting) -> tuple[PartState, str]:
    """Whether the shared store answers: without it, what is in memory and what has a copy here still does."""
    try:
        storage.files.check()
    except OSError as error:
        return "warning", f"{error.strerror or error}: nothing can be uploaded, trained or loaded"
    return "ok", "the shared store answers"


class HomeError(RuntimeError):
    """No service can start on the home; the message says why and what would help."""


class HomeInUseError(HomeError):
    """Another service works on the same home."""


def hold_home(home: Path) -> ExitStack:
    """Hold the home for this process; the locks end with the process, however it ends. Raise HomeError.

    The folder itself is locked: a file in it could be deleted, and made again by a second service. The file is locked
    too, because NFS and others lock no folders.
    """
    with ExitStack() as held:
        try:
            make_folder(home, 0o700)
            folder = os.open(home, os.O_RDONLY | os.O_DIRECTORY)
            held.callback(os.close, folder)
            file = held.enter_context((home / ".lock").open("w"))
        except OSError as error:
            raise HomeError(_unusable(home, error)) from error
        for each, needed in ((folder, False), (file, True)):
            try:
                fcntl.flock(each, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if needed or isinstance(error, BlockingIOError):
                    message = f"another service uses {home}: stop it, or set LIPSERVE_HOME to another folder"
                    raise HomeInUseError(message) from None
        return held.pop_all()


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
    except (DatabaseVersionError, MissingExtraError) as error:
        raise HomeError(str(error)) from error
    except FilesUnreachableError as error:
        raise HomeError(_unusable_files(settings, error)) from error
    except SQLAlchemyError as error:
        raise HomeError(_unusable_database(settings, str(getattr(error, "orig", None) or error))) from error


def _damage(settings: Settings) -> str | None:
    """What is wrong with the database, None where it is whole."""
    database = Database.of(settings, WAIT_S)
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
    damage = " ".join(damage.split())  # SQLite's comes in several lines
    if settings.database_url is not None:
        return f"the database of LIPSERVE_DATABASE_URL cannot be used: {damage}"
    path = settings.home / FILE
    return (
        f"the database {path} cannot be used: {damage}. Where it is damaged, restore a copy of the home, or what "
        f'can be read of it with `sqlite3 {path} ".recover"`; or set LIPSERVE_HOME to another folder'
    )
