"""Limits of disk space: a quota of the home, and space that stays free on its disk."""

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
"""Seconds between two measurements of the size of the home, to which other processes write too."""
RECHECK_S = 1.0
"""Seconds after which the size of a full home is measured again, as files may have been deleted."""


@dataclass(frozen=True)
class Usage:
    """Used and free space, and its limits, in bytes."""

    used: int
    """Bytes of the home."""
    free: int
    """Bytes free on its disk for this user."""
    quota: int | None
    """Max bytes of the home, None if not limited."""
    floor: int
    """Bytes that stay free on the disk."""

    def shortage(self, size: int = 0) -> str | None:
        """Return why there is no space for `size` more bytes, None if there is."""
        if self.free - size < self.floor:
            return (
                f"the disk is full: {_amount(self.free)} are free, and {_amount(self.floor)} must stay free "
                "(LIPSERVE_MIN_FREE_BYTES)"
            )
        if self.quota is not None and self.used + size > self.quota:
            return f"the quota is full: {_amount(self.used)} of {_amount(self.quota)} in use (LIPSERVE_MAX_HOME_BYTES)"
        return None


class DiskBudget:
    """The free space of a disk at one moment, for a process that cannot measure it."""

    def __init__(self, usage: Usage) -> None:
        self._usage, self._taken = usage, 0

    def reserve(self, size: int) -> None:
        """Count bytes that are written next; raise StorageFullError."""
        self._taken += size
        if (reason := self._usage.shortage(self._taken)) is not None:
            raise _full(reason)


class Disk:
    """The disk of the home; safe from several threads. Each writing process has one of its own.

    Between two measurements, writes are counted by `reserve`.
    """

    def __init__(self, settings: Settings) -> None:
        self.home, self.quota, self.floor = settings.home, settings.max_home_bytes, settings.min_free_bytes
        self._lock = threading.Lock()
        self._used, self._measured = 0, -float("inf")

    def require(self, size: int = 0) -> None:
        """Check that there is space for `size` bytes; raise StorageFullError. Blocking: use it in a thread."""
        if self.usage().shortage(size) is None:
            return
        reason = self.usage(RECHECK_S).shortage(size)
        if reason is not None:
            raise _full(reason)

    def reserve(self, size: int) -> None:
        """Check that there is space for `size` bytes that are written next, and count them; raise as `require`."""
        self.require(size)
        self._used += size  # a lost update of another thread is corrected by the next measurement

    def usage(self, age: float = MEASURE_S) -> Usage:
        """Return used and free space. Blocking: use it in a thread.

        The home is measured again if the last measurement is at least `age` old, s.
        """
        if time.monotonic() - self._measured >= age and self._lock.acquire(blocking=self._measured < 0):
            try:
                self._used, self._measured = measure(self.home), time.monotonic()
            finally:
                self._lock.release()
        return Usage(self._used, shutil.disk_usage(self.home).free, self.quota, self.floor)


def _full(reason: str) -> StorageFullError:
    return StorageFullError(f"{reason}. Delete data sets or versions")


def measure(folder: Path) -> int:
    """Return the bytes of all files below a folder, without links and files that vanish meanwhile."""
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
    """Format bytes for people."""
    amount, units = float(size), ["bytes", "KiB", "MiB", "GiB", "TiB"]
    while amount >= 1024 and len(units) > 1:
        amount, units = amount / 1024, units[1:]
    return f"{amount:.4g} {units[0]}"
