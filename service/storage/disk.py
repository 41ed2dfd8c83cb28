"""How much of a disk the service may take: by a quota of its home, and by space that it leaves free."""

from __future__ import annotations

import os
import shutil
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from service.foundation.errors import StorageFullError
from service.foundation.settings import Settings

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


class Room:
    """What was free of a disk, for a process that cannot look itself."""

    def __init__(self, usage: Usage) -> None:
        self._usage, self._taken = usage, 0

    def take(self, size: int) -> None:
        """Count bytes that are written right after this; raise StorageFullError."""
        self._taken += size
        if (reason := self._usage.shortage(self._taken)) is not None:
            raise _full(reason)


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
            raise _full(reason)

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


def _full(reason: str) -> StorageFullError:
    return StorageFullError(f"{reason}, which leaves no room for more: delete data sets or versions of models")


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
