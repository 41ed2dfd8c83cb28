"""Object stores that several services share: a bucket, or a folder that all hosts mount.

An object is immutable, and is stored whole or not at all. Keys are relative, such as `datasets/ds_1.safetensors`, as
below a home.
"""

from __future__ import annotations

import builtins
import errno
import logging
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar
from urllib.parse import unquote, urlsplit

from lipcore.extras import import_extra
from lipcore.files.durable import make_folder
from service.storage.files import local

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

FIRST_PAUSE_S = 0.5
"""First pause before a retry, s; doubled each time."""


class FilesUnreachableError(OSError):
    """The shared store cannot be reached or used now; nothing was stored. Made by `unreachable`."""


def unreachable(reason: str) -> FilesUnreachableError:
    """Return the error for an unusable store. reason: for people, without addresses and secrets."""
    return FilesUnreachableError(errno.EIO, f"the shared files: {reason}")


class Entry(NamedTuple):
    """An object of a listing. modified: Unix time by the clock of the store, s."""

    key: str
    modified: float


class ObjectStore(Protocol):
    """Operations of a store.

    Its errors are FilesUnreachableError, FileNotFoundError of `get`, and errors of this host's disk.
    """

    def put(self, path: Path, key: str) -> None:
        """Store a file durably; after the return all services see it."""

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError if there is none."""

    def delete(self, key: str) -> None:
        """Delete an object; do nothing if there is none."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield objects with keys that begin with `prefix`.

        prefix: a folder's name, a slash, and optionally the beginning of a name in the folder.
        """

    def check(self) -> None:
        """Check that the store answers, within a few seconds."""


class RetryingStore:
    """A store that retries for `seconds` if it cannot be reached, for work that no request waits for."""

    def __init__(self, objects: ObjectStore, seconds: float) -> None:
        self._objects, self._seconds = objects, seconds

    def put(self, path: Path, key: str) -> None:
        """Store a file durably."""
        self._ask(lambda: self._objects.put(path, key))

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError if there is none."""
        self._ask(lambda: self._objects.get(key, path))

    def delete(self, key: str) -> None:
        """Delete an object; do nothing if there is none."""
        self._objects.delete(key)

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield objects with keys that begin with `prefix`."""
        return iter(self._ask(lambda: builtins.list(self._objects.list(prefix))))

    def check(self) -> None:
        """Check that the store answers, within a few seconds."""
        self._objects.check()

    def _ask(self, question: Callable[[], Result]) -> Result:
        end, pause = time.monotonic() + self._seconds, FIRST_PAUSE_S
        while True:
            try:
                return question()
            except FilesUnreachableError as error:
                if time.monotonic() + pause > end:
                    raise
                logger.warning("%s; retrying in %g s", error.strerror, pause)
            time.sleep(pause)
            pause = min(2 * pause, 8.0)


def make_store(url: str) -> ObjectStore:
    """Return the store of a valid `files_url`, without a request to it.

    Raise MissingExtraError if its library is not installed.
    """
    parts = urlsplit(url)
    if parts.scheme == "file":
        return FolderStore(Path(unquote(parts.path)))
    import_extra("s3fs", "cluster", "LIPSERVE_FILES_URL is set")
    from service.storage.files.bucket import Bucket  # noqa: PLC0415 - its library is an extra

    return Bucket(parts.netloc, parts.path.strip("/"))


class FolderStore:
    """Objects as files below a folder that must exist: a folder that is not mounted is not created instead."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def put(self, path: Path, key: str) -> None:
        """Store a file durably."""
        target = self.root / key
        with _of_folder():
            self.check()
            if not target.parent.is_dir():
                make_folder(target.parent)
            with path.open("rb") as file:
                draft = target.parent / f".draft-{secrets.token_hex(8)}"
                local.write_durably(target, lambda out: shutil.copyfileobj(file, out, 1 << 20), draft)

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError if there is none."""
        with _of_folder():
            try:
                shutil.copyfile(self.root / key, path)
            except FileNotFoundError:
                self.check()
                raise

    def delete(self, key: str) -> None:
        """Delete an object, and its subfolder if it was the last object there."""
        path = self.root / key
        with _of_folder():
            path.unlink(missing_ok=True)
            if path.parent.parent != self.root:
                try:
                    path.parent.rmdir()
                except OSError:  # not empty, or already deleted
                    return

    def list(self, prefix: str) -> Iterator[Entry]:
        """Yield objects with keys that begin with `prefix`, with leftovers of an interrupted `put`."""
        parent, _, beginning = prefix.rpartition("/")
        with _of_folder():
            self.check()
            folder = self.root / parent
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if path.name.startswith(beginning):
                    yield from self._below(path)

    def _below(self, path: Path) -> Iterator[Entry]:
        for each in path.iterdir() if path.is_dir() else [path]:
            with suppress(FileNotFoundError):  # deleted meanwhile
                yield Entry(each.relative_to(self.root).as_posix(), each.stat().st_mtime)

    def check(self) -> None:
        """Check that the folder exists."""
        if not self.root.is_dir():
            raise unreachable(f"there is no folder {str(self.root)!r}: is it mounted?")


@contextmanager
def _of_folder() -> Iterator[None]:
    """Translate errors of the folder into those of a store; a full disk stays one."""
    try:
        yield
    except (FileNotFoundError, FilesUnreachableError):
        raise
    except PermissionError:
        raise unreachable("access is denied: this user may not read and write the folder") from None
