"""What a service keeps things in: a database, a store of files, a disk, a home folder; how these are; how much of the
disk it may take, by a quota of its home and by space that it leaves free. The home belongs to one running service at a
time, and has to be whole before one starts on it."""

from __future__ import annotations

import fcntl
import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import Depends
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from lipcore.extras import MissingExtraError
from lipcore.files.durable import make_folder
from lipserve.states import PartState
from service.foundation.errors import StorageFullError
from service.foundation.fields import of_app
from service.foundation.settings import Settings
from service.storage.database.engine import FILE, Database
from service.storage.database.migrations import DatabaseVersionError
from service.storage.files import Files, FilesUnreachableError

MEASURE_S = 10.0
"""Seconds after which the home is measured again: the database and other processes write to it too."""
AGAIN_S = 1.0
"""Seconds after which a home that seems full is measured again: something may have been deleted."""


@dataclass(frozen=True)
class Usage:
    """Bytes: used by the home, free on its disk for this user; the limits of both. quota: None where there is none."""

    used: int
    free: int
    quota: int | None
    floor: int

    def shortage(self, size: int = 0) -> str | None:
        """Say why `size` more bytes find no room, None where they do."""
        if self.free - size < self.floor:
            return (
                f"the disk of the service has {_amount(self.free)} free, of which {_amount(self.floor)} stay so "
                "(LIPSERVE_MIN_FREE_BYTES)"
            )
        if self.quota is not None and self.used + size > self.quota:
            return f"the service has stored {_amount(self.used)} of {_amount(self.quota)} (LIPSERVE_MAX_HOME_BYTES)"
        return None


class Disk:
    """The disk that the home lies on; safe from several threads. Each process that writes has one of its own.

    What is written between two measurements is known from those who ask before they write.
    """

    def __init__(self, settings: Settings) -> None:
        self.home, self.quota, self.floor = settings.home, settings.max_home_bytes, settings.min_free_bytes
        self._lock = threading.Lock()
        self._used, self._measured = 0, -float("inf")

    def require(self, size: int = 0) -> None:
        """Make sure that there is room for `size` bytes; raise StorageFullError. Not for the event loop."""
        if self.usage().shortage(size) is None:
            return
        reason = self.usage(AGAIN_S).shortage(size)
        if reason is not None:
            raise StorageFullError(f"{reason}, which leaves no room for more: delete data sets or versions of models")

    def take(self, size: int) -> None:
        """Make sure of room for `size` bytes that are written right after this; raise as `require`."""
        self.require(size)
        self._used += size  # where another thread adds at the same time, the next measurement puts it right

    def usage(self, age: float = MEASURE_S) -> Usage:
        """What is used and free; the home is measured where that was done `age` s ago. Not for the event loop."""
        if time.monotonic() - self._measured >= age and self._lock.acquire(blocking=self._measured < 0):
            try:
                self._used, self._measured = measure(self.home), time.monotonic()
            finally:
                self._lock.release()
        return Usage(self._used, shutil.disk_usage(self.home).free, self.quota, self.floor)


def measure(folder: Path) -> int:
    """Bytes of all files below a folder, links not followed; what vanishes meanwhile does not count."""
    total, folders = 0, [os.fspath(folder)]
    while folders:
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):
                    if entry.is_dir(follow_symlinks=False):
                        folders.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
    return total


def _amount(size: int) -> str:
    """Bytes for people."""
    amount, units = float(size), ["bytes", "KiB", "MiB", "GiB", "TiB"]
    while amount >= 1024 and len(units) > 1:
        amount, units = amount / 1024, units[1:]
    return f"{amount:.4g} {units[0]}"


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
        return cls(settings, Database.of(settings, settings.database_timeout_s), Files.of(settings), Disk(settings))


StorageDep = Annotated[Storage, Depends(of_app("storage"))]


WRITE_S = 2.0
"""Longest wait in s for another writer of the database: commits take milliseconds."""
PROBE = bytes(4096)


def look_database(storage: Storage) -> tuple[PartState, str]:
    """Whether the database answers, and can be written in time."""
    with storage.database.session() as session:
        session.execute(text("SELECT 1"))
    storage.database.adapter.check(WRITE_S)
    return "ok", "can be read and written"


def look_home(storage: Storage) -> tuple[PartState, str]:
    """Whether the home can be written, and has room."""
    path = storage.files.upload()
    try:
        path.write_bytes(PROBE)
    finally:
        path.unlink(missing_ok=True)
    shortage = storage.disk.usage().shortage()
    return ("ok", "can be written") if shortage is None else ("failed", shortage)


def look_files(storage: Storage) -> tuple[PartState, str]:
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
    for releases up to 0.1, which know nothing else.
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
                if needed or isinstance(error, BlockingIOError):  # NFS and others lock no folders
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
    damage = " ".join(damage.split())  # SQLite's comes in several lines
    if settings.database_url is not None:
        return f"the database of LIPSERVE_DATABASE_URL cannot be used: {damage}"
    path = settings.home / FILE
    return (
        f"the database {path} cannot be used: {damage}. Where it is damaged, restore a copy of the home, or what "
        f'can be read of it with `sqlite3 {path} ".recover"`; or set LIPSERVE_HOME to another folder'
    )
