"""Files in a store that several services share, with copies below the home of what was used here last.

Everything is immutable under a random name, so that a copy is right for ever. Copies lie below `cache` under the keys
of their objects. A copy comes by renaming one that is whole, so that processes of one home may fetch at once.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, TypeVar

from lipcore.files.manifest import MANIFEST
from service.storage.files.local import remove
from service.storage.files.objects import Entry, Objects

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

GRACE_S = 600.0
"""Seconds since its last use for which a copy is kept in any case: whoever was given its path may still open it."""
DAY_S = 86400.0
"""Age in s from which on an object that no row names has been left: before, its row may still be to come."""
SUFFIX = ".safetensors"


class Shared:
    """Files of all services. home: of this one; most: bytes of copies that it keeps, those in use aside."""

    shared = True

    def __init__(self, home: Path, objects: Objects, most: int) -> None:
        self.objects, self._most = objects, most
        self._cache, self._drafts = home / "cache", home / "cache" / "drafts"
        self.datasets, self.versions = self._cache / "datasets", self._cache / "versions"
        self.snapshots = self._cache / "learning"
        for folder in (self._drafts, *self._copies):
            folder.mkdir(parents=True, exist_ok=True)

    @property
    def kinds(self) -> Mapping[str, Path]:
        """Folders on the disk of the home, by what is in them."""
        return {"cache": self._cache}

    def file(self, key: str, again: bool = False) -> Path:
        """Where a copy of a file lies, fetched if need be; no file is there where none is stored.

        again: another copy than the one before, which is damaged.
        """
        target = self._cache / key
        if not again and _used(target):
            return target
        with self._draft(target.name) as draft, suppress(FileNotFoundError):
            self.objects.get(key, draft / target.name)
            (draft / target.name).replace(target)
        self._trim()
        return target

    def write(self, key: str, write: Callable[[IO[bytes]], Result]) -> Result:
        """Store a file for all, whole or not at all, and keep a copy; return what `write` does."""
        target = self._cache / key
        with self._draft(target.name) as draft:
            path = draft / target.name
            with path.open("wb") as file:
                result = write(file)
            self.objects.put(path, key)
            path.replace(target)
        self._trim()
        return result

    def delete(self, key: str) -> None:
        """Delete a file for all; nothing happens where there is none."""
        self.objects.delete(key)
        (self._cache / key).unlink(missing_ok=True)

    def version(self, name: str, again: bool = False) -> Path:
        """Folder of a copy of a version, fetched if need be; see `file`."""
        target = self.versions / name
        if not again and _used(target):
            return target
        with self._draft(name) as draft:
            folder = draft / name
            if self._fetch(name, folder):
                if again and target.exists():
                    target.rename(draft / "damaged")
                with suppress(OSError):  # another process was faster
                    folder.rename(target)
        self._trim()
        return target

    def has_version(self, name: str) -> bool:
        """Whether the files of a version are there, as far as can be told at once: those who load it find out."""
        return True

    @contextmanager
    def new_version(self, name: str) -> Iterator[Path]:
        """Give a folder to be made in the block, which is stored for all at its end."""
        with self._draft(name) as draft:
            folder = draft / name
            yield folder
            try:
                for path in sorted(folder.iterdir(), key=lambda each: each.name == MANIFEST):  # that one last
                    self.objects.put(path, f"versions/{name}/{path.name}")
            except BaseException:
                self._withdraw(name)
                raise
            folder.rename(self.versions / name)
        self._trim()

    def delete_version(self, name: str) -> None:
        """Delete a version's files for all, and what was begun of it here."""
        objects = sorted(self.objects.list(f"versions/{name}/"), key=lambda each: not each.key.endswith(MANIFEST))
        for each in objects:  # the manifest first: what is left is no version
            self.objects.delete(each.key)
        for path in (self.versions / name, *self._drafts.glob(f"{name}-*")):
            shutil.rmtree(path, ignore_errors=True)

    def versions_marked(self, mark: str, ended: bool = True) -> list[str]:
        """Names of versions, also of those begun here, that begin with `mv_` and `mark`; once their job has ended."""
        if not ended:
            return []
        names = {each.key.split("/")[1] for each in self.objects.list(f"versions/mv_{mark}")}
        return sorted(names | {path.name.rpartition("-")[0] for path in self._drafts.glob(f"mv_{mark}*")})

    def drafts(self) -> Iterable[Path]:
        """What earlier processes had begun to fetch or to write."""
        return [path for used, _, path in _entries(self._drafts) if used < time.time() - GRACE_S]

    def sweep(self, datasets: Collection[str], versions: Collection[str], snapshots: Collection[str]) -> int:
        """Delete what is none of these and a day old, in one place for all services; return how many."""
        old = partial(self._old, self._now() - DAY_S)
        left = [each for each in old("datasets/") if _name(each).removesuffix(SUFFIX) not in datasets]
        left += [each for each in old("versions/") if each.key.split("/")[1] not in versions]
        left += [each for each in old("learning/") if _name(each).removesuffix(SUFFIX) not in snapshots]
        for each in left:
            self.objects.delete(each.key)
        return len(left)

    def sweep_snapshots(self, named: Collection[str]) -> int:
        """Nothing: another service may be about to name the others."""
        return 0

    @contextmanager
    def fresh(self) -> Iterator[Shared]:
        """The same files without the copies: each is fetched when it is asked for, and gone when another one is."""
        with self._draft("fresh") as folder:
            yield _Fresh(folder, self.objects, self._most)

    def check(self) -> None:
        """See that the store answers; raise FilesUnreachableError."""
        self.objects.check()

    def try_out(self) -> None:
        """See that objects can be written, read, listed and deleted; raise FilesUnreachableError or OSError."""
        self.objects.check()
        with self._draft("probe") as draft:
            path, key = draft / "probe", f"probes/{draft.name}"
            path.write_bytes(b"probe")
            self.objects.put(path, key)
            self.objects.get(key, draft / "copy")
            list(self.objects.list("probes/"))
            self.objects.delete(key)

    @property
    def _copies(self) -> tuple[Path, ...]:
        return self.datasets, self.versions, self.snapshots

    @contextmanager
    def _draft(self, name: str) -> Iterator[Path]:
        """An empty folder of its own, which tells by its name whose it is; gone after the block."""
        path = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._drafts))
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def _fetch(self, name: str, folder: Path) -> bool:
        """Copy all files of a version into a new folder; return False where it is not stored, or not any more."""
        keys = [each.key for each in self.objects.list(f"versions/{name}/")]
        if f"versions/{name}/{MANIFEST}" not in keys:
            return False
        folder.mkdir()
        try:
            for key in keys:
                self.objects.get(key, folder / key.rpartition("/")[2])
        except FileNotFoundError:
            return False
        return True

    def _withdraw(self, name: str) -> None:
        try:
            self.delete_version(name)
        except OSError as error:
            logger.warning("files of a version that was not made are left for a day: %s", error)

    def _old(self, before: float, prefix: str) -> Iterator[Entry]:
        return (each for each in self.objects.list(prefix) if each.modified < before)

    def _now(self) -> float:
        """The time by the clock of the store, s, which has dated its objects: this host's may be days ahead of it."""
        with self._draft("probe") as draft:
            key = f"probes/{draft.name}"
            (draft / "probe").touch()
            self.objects.put(draft / "probe", key)
            try:
                return next(each.modified for each in self.objects.list("probes/") if each.key == key)
            finally:
                self.objects.delete(key)

    def _trim(self) -> None:
        """Delete the copies that were not used for the longest time, down to the bytes allowed; and old drafts."""
        now, copies = time.time(), [entry for folder in self._copies for entry in _entries(folder)]
        size = sum(each for _, each, _ in copies)
        for used, each, path in sorted(copies):
            if size <= self._most or used > now - GRACE_S:
                break
            with self._draft(path.name) as draft, suppress(FileNotFoundError):
                path.rename(draft / path.name)  # so that nobody finds half of it
            size -= each
        for used, _, path in _entries(self._drafts):
            if used < now - DAY_S:
                shutil.rmtree(path, ignore_errors=True)


class _Fresh(Shared):
    """For one thread that looks at one file after the other."""

    def file(self, key: str, again: bool = False) -> Path:
        self._forget()
        return super().file(key, again)

    def version(self, name: str, again: bool = False) -> Path:
        self._forget()
        return super().version(name, again)

    def _forget(self) -> None:
        os.utime(self._cache.parent)  # it is in use
        for folder in self._copies:
            for path in folder.iterdir():
                remove(path)


def _used(path: Path) -> bool:
    """Whether there is a copy; it counts as used."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    return True


def _entries(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """When each copy in a folder was used last, its bytes, and where it is."""
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            about = path.stat()
            files = path.iterdir() if path.is_dir() else ()
            size = sum(each.stat().st_size for each in files) if path.is_dir() else about.st_size
            yield about.st_mtime, size, path


def _name(entry: Entry) -> str:
    return entry.key.rpartition("/")[2]
