"""The storage of a service: database, file store, disk and home folder, with their readiness.

The home belongs to one running service at a time, and is checked before a service starts on it.
"""

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
from service.telemetry.readiness import FaultAge, Probe

WAIT_S = 10.0
"""Max wait of a request for another writer of the database, s; then it is answered 503."""


@dataclass(frozen=True)
class Storage:
    """The storage of a running service, and its limits."""

    settings: Settings
    database: Database
    files: Files
    disk: Disk

    @classmethod
    def open(cls, settings: Settings) -> Storage:
        """Open, or create, the storage that the settings name."""
        return cls(settings, Database.of(settings, WAIT_S), Files.of(settings), Disk(settings))

    def probes(self) -> dict[str, Probe]:
        """Return the readiness probes of all parts, by name."""
        parts = {"database": probe_database, "home": probe_home} | ({"files": probe_files} if self.files.shared else {})
        return {name: partial(look, self) for name, look in parts.items()}


WRITE_S = 2.0
"""Max wait of a probe for another writer of the database, s: commits take milliseconds."""


def probe_database(storage: Storage, _: FaultAge) -> tuple[PartState, str]:
    """Check that the database can be read, and written in time."""
    with storage.database.session() as session:
        session.execute(text("SELECT 1"))
    storage.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def probe_home(storage: Storage, _: FaultAge) -> tuple[PartState, str]:
    """Check that the home can be written, and has space."""
    path = storage.files.upload()
    try:
        path.write_bytes(bytes(4096))
    finally:
        path.unlink(missing_ok=True)
    shortage = storage.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def probe_files(storage: Storage, _: FaultAge) -> tuple[PartState, str]:
    """Check that the shared store answers: without it, models in memory and files with a local copy still work."""
    try:
        storage.files.check()
    except OSError as error:
        return "warning", f"{error.strerror or error}: nothing can be uploaded, trained or loaded"
    return "ok", "the shared store answers"


class HomeError(RuntimeError):
    """No service can start on the home; the message contains the reason and the remedy."""


class HomeInUseError(HomeError):
    """Another service uses the same home."""


def lock_home(home: Path) -> ExitStack:
    """Lock the home for this process; return the locks, which end with the process. Raise HomeError.

    The folder itself is locked: a file in it could be deleted, and created again by a second service. A file is locked
    too, because NFS and others cannot lock folders.
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
    """Check that a service can start: the home is unused and writable, its database undamaged and up to date.

    Takes about 0.5 s per GB of the database, and 4 µs per batch of the log. Raise HomeError.
    """
    home = settings.home
    with lock_home(home), explain_home_errors(settings):
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
def explain_home_errors(settings: Settings) -> Iterator[None]:
    """Raise HomeError with advice if the block cannot use the database or shared files."""
    try:
        yield
    except (DatabaseVersionError, MissingExtraError) as error:
        raise HomeError(str(error)) from error
    except FilesUnreachableError as error:
        raise HomeError(_unusable_files(settings, error)) from error
    except SQLAlchemyError as error:
        raise HomeError(_unusable_database(settings, str(getattr(error, "orig", None) or error))) from error


def _damage(settings: Settings) -> str | None:
    """Return the first fault of the database, None if there is none."""
    database = Database.of(settings, WAIT_S)
    try:
        with database.transaction():  # fails if the database is read-only
            pass
        return next(iter(database.adapter.damage()), None)
    finally:
        database.close()


def _unusable(home: Path, error: OSError) -> str:
    return f"home is {str(home)!r}, expected a folder that the service may write to: {error.strerror or error}"


def _unusable_files(settings: Settings, error: OSError) -> str:
    expected = "a folder that is mounted and that the service may write to"
    if (settings.files_url or "").startswith("s3:"):
        expected = "a bucket in which the service may list, read, write and delete (AWS_ variables or a role)"
    return f"files_url is {settings.files_url!r}, expected {expected}: {error.strerror or error}"


def _unusable_database(settings: Settings, damage: str) -> str:
    damage = " ".join(damage.split())  # SQLite's text has several lines
    if settings.database_url is not None:
        return f"the database of LIPSERVE_DATABASE_URL cannot be used: {damage}"
    path = settings.home / FILE
    return (
        f"the database {path} cannot be used: {damage}. If it is damaged, restore a backup of the home, or recover "
        f'what is readable with `sqlite3 {path} ".recover"`; or set LIPSERVE_HOME to another folder'
    )
