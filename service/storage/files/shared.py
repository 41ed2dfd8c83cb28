"""Files in a store that several services share, with a cache of recently used copies below the home.

All files are immutable under random names, so that a copy is valid for ever. Copies lie below `cache` under the keys of
their objects. A complete copy is renamed into its place, so that several processes of one home may fetch it at once.
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
from service.storage.files.objects import Entry, ObjectStore

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

GRACE_S = 600.0
"""Seconds for which an unused copy is kept, because a caller that has its path may still open it."""
DAY_S = 86400.0
"""Age from which an object without a row counts as left over, s: before, its row may not be written yet."""
SUFFIX = ".safetensors"


class SharedFiles:
    """Files of all services. home: of this service. most: max bytes of cached copies, apart from those in use."""

    shared = True

    def __init__(self, home: Path, objects: ObjectStore, most: int) -> None:
        self.objects, self._most = objects, most
        self._cache, self._drafts = home / "cache", home / "cache" / "drafts"
        self.datasets, self.versions = self._cache / "datasets", self._cache / "versions"
        self.snapshots = self._cache / "learning"
        for folder in (self._drafts, *self._copies):
            folder.mkdir(parents=True, exist_ok=True)

    @property
    def kinds(self) -> Mapping[str, Path]:
        """Folders on the disk of the home, by their content."""
        return {"cache": self._cache}

    def file(self, key: str, again: bool = False) -> Path:
        """Return the path of a copy, fetched if needed; no file is there if none is stored.

        again: fetch it again, as the copy is damaged.
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
        """Store a file for all services, whole or not at all, and keep a copy; return the result of `write`."""
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
        """Delete a file for all services; do nothing if there is none."""
        self.objects.delete(key)
        (self._cache / key).unlink(missing_ok=True)

    def version(self, name: str, again: bool = False) -> Path:
        """Return the folder of the local copy of a version; fetch it if needed. See `file`."""
        target = self.versions / name
        if not again and _used(target):
            return target
        with self._draft(name) as draft:
            folder = draft / name
            if self._fetch(name, folder):
                if again and target.exists():
                    target.rename(draft / "damaged")
                with suppress(OSError):  # another process has fetched it meanwhile
                    folder.rename(target)
        self._trim()
        return target

    def has_version(self, name: str) -> bool:
        """Return True without a check, which would need the store; loading a missing version fails."""
        return True

    @contextmanager
    def new_version(self, name: str) -> Iterator[Path]:
        """Yield a folder for the block to create; store it for all services at the end."""
        with self._draft(name) as draft:
            folder = draft / name
            yield folder
            try:
                for path in sorted(folder.iterdir(), key=lambda each: each.name == MANIFEST):  # the manifest last
                    self.objects.put(path, f"versions/{name}/{path.name}")
            except BaseException:
                self._withdraw(name)
                raise
            folder.rename(self.versions / name)
        self._trim()

    def delete_version(self, name: str) -> None:
        """Delete a version's files for all services, and its drafts here."""
        objects = sorted(self.objects.list(f"versions/{name}/"), key=lambda each: not each.key.endswith(MANIFEST))
        for each in objects:  # the manifest first: files without it are no version
            self.objects.delete(each.key)
        for path in (self.versions / name, *self._drafts.glob(f"{name}-*")):
            shutil.rmtree(path, ignore_errors=True)

    def versions_marked(self, mark: str, ended: bool = True) -> list[str]:
        """Return names of versions and local drafts that begin with `mv_` and `mark`.

        ended: whether their job has ended; no name is returned before.
        """
        if not ended:
            return []
        names = {each.key.split("/")[1] for each in self.objects.list(f"versions/mv_{mark}")}
        return sorted(names | {path.name.rpartition("-")[0] for path in self._drafts.glob(f"mv_{mark}*")})

    def drafts(self) -> Iterable[Path]:
        """Return unfinished downloads and writes of earlier processes."""
        return [path for used, _, path in _entries(self._drafts) if used < time.time() - GRACE_S]

    def sweep(self, datasets: Collection[str], versions: Collection[str], snapshots: Collection[str]) -> int:
        """Delete files that are none of these and a day old, for all services; return their number."""
        old = partial(self._old, self._now() - DAY_S)
        left = [each for each in old("datasets/") if _name(each) not in datasets]
        left += [each for each in old("versions/") if each.key.split("/")[1] not in versions]
        left += [each for each in old("learning/") if _name(each).removesuffix(SUFFIX) not in snapshots]
        for each in left:
            self.objects.delete(each.key)
        return len(left)

    def sweep_snapshots(self, named: Collection[str]) -> int:
        """Delete nothing: another service may be about to name a snapshot."""
        return 0

    @contextmanager
    def fresh(self) -> Iterator[SharedFiles]:
        """Yield the same files without a cache: each file is fetched, and deleted when the next one is."""
        with self._draft("fresh") as folder:
            yield _UncachedFiles(folder, self.objects, self._most)

    def check(self) -> None:
        """Check that the store answers; raise FilesUnreachableError."""
        self.objects.check()

    def try_out(self) -> None:
        """Check that objects can be written, read, listed and deleted; raise FilesUnreachableError or OSError."""
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
        """Yield an empty temporary folder with a name that begins with `name`; it is deleted after the block."""
        path = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=self._drafts))
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def _fetch(self, name: str, folder: Path) -> bool:
        """Copy all files of a version into a new folder; return False if it is not stored."""
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
            logger.warning("could not delete files of a failed version; they stay for a day: %s", error)

    def _old(self, before: float, prefix: str) -> Iterator[Entry]:
        return (each for each in self.objects.list(prefix) if each.modified < before)

    def _now(self) -> float:
        """Return the time by the clock of the store, s.

        That clock dates the objects; this host's clock may be days ahead of it.
        """
        with self._draft("probe") as draft:
            key = f"probes/{draft.name}"
            (draft / "probe").touch()
            self.objects.put(draft / "probe", key)
            try:
                return next(each.modified for each in self.objects.list("probes/") if each.key == key)
            finally:
                self.objects.delete(key)

    def _trim(self) -> None:
        """Delete the least recently used copies down to the max size, and old drafts."""
        now, copies = time.time(), [entry for folder in self._copies for entry in _entries(folder)]
        size = sum(each for _, each, _ in copies)
        for used, each, path in sorted(copies):
            if size <= self._most or used > now - GRACE_S:
                break
            with self._draft(path.name) as draft, suppress(FileNotFoundError):
                path.rename(draft / path.name)  # renamed first, so that no process finds half of it
            size -= each
        for used, _, path in _entries(self._drafts):
            if used < now - DAY_S:
                shutil.rmtree(path, ignore_errors=True)


class _UncachedFiles(SharedFiles):
    """Files for one thread that reads one file after the other."""

    def file(self, key: str, again: bool = False) -> Path:
        self._forget()
        return super().file(key, again)

    def version(self, name: str, again: bool = False) -> Path:
        self._forget()
        return super().version(name, again)

    def _forget(self) -> None:
        os.utime(self._cache.parent)  # marks the folder as in use
        for folder in self._copies:
            for path in folder.iterdir():
                remove(path)


def _used(path: Path) -> bool:
    """Return whether there is a copy, and mark it as used."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    return True


def _entries(folder: Path) -> Iterator[tuple[float, int, Path]]:
    """Yield the time of last use, the bytes and the path of each copy in a folder."""
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            about = path.stat()
            files = path.iterdir() if path.is_dir() else ()
            size = sum(each.stat().st_size for each in files) if path.is_dir() else about.st_size
            yield about.st_mtime, size, path


def _name(entry: Entry) -> str:
    return entry.key.rpartition("/")[2]
