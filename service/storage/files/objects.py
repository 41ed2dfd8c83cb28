"""Stores of whole objects that several services share: a bucket, or a folder that all hosts mount.

An object is immutable, and there whole or not at all. Keys are relative: `datasets/ds_1.safetensors`, as below a home.
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

from lipcore.extras import need
from lipcore.files.durable import make_folder
from service.storage.files import local

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

FIRST_PAUSE_S = 0.5
"""Pauses before a store is asked again: each time twice as long."""


class FilesUnreachableError(OSError):
    """The shared store cannot be reached or used now; nothing was stored. Made by `unreachable`."""


def unreachable(reason: str) -> FilesUnreachableError:
    """The error for a store that cannot be used; reason: for people, without addresses and secrets."""
    return FilesUnreachableError(errno.EIO, f"the shared files: {reason}")


class Entry(NamedTuple):
    """An object of a listing. modified: s since 1970, by the clock of the store."""

    key: str
    modified: float


class Objects(Protocol):
    """What a store does. All but FileNotFoundError of `get` is FilesUnreachableError, or of the disk of this host."""

    def put(self, path: Path, key: str) -> None:
        """Store a file durably; once this returns everybody sees it."""

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError where there is none."""

    def delete(self, key: str) -> None:
        """Delete an object; nothing happens where there is none."""

    def list(self, prefix: str) -> Iterator[Entry]:
        """Objects whose keys begin so: the name of a folder, a slash, and maybe the beginning of a name in it."""

    def check(self) -> None:
        """See that the store answers, in a few seconds at most."""


class Patient:
    """A store that is asked again for so many seconds while it cannot be reached: for work that nobody waits for."""

    def __init__(self, objects: Objects, seconds: float) -> None:
        self._objects, self._seconds = objects, seconds

    def put(self, path: Path, key: str) -> None:
        """Store a file durably."""
        self._ask(lambda: self._objects.put(path, key))

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError where there is none."""
        self._ask(lambda: self._objects.get(key, path))

    def delete(self, key: str) -> None:
        """Delete an object; nothing happens where there is none."""
        self._objects.delete(key)

    def list(self, prefix: str) -> Iterator[Entry]:
        """Objects whose keys begin so."""
        return iter(self._ask(lambda: builtins.list(self._objects.list(prefix))))

    def check(self) -> None:
        """See that the store answers, in a few seconds at most."""
        self._objects.check()

    def _ask(self, question: Callable[[], Result]) -> Result:
        end, pause = time.monotonic() + self._seconds, FIRST_PAUSE_S
        while True:
            try:
                return question()
            except FilesUnreachableError as error:
                if time.monotonic() + pause > end:
                    raise
                logger.warning("%s: asked again in %g s", error.strerror, pause)
            time.sleep(pause)
            pause = min(2 * pause, 8.0)


def store_of(url: str) -> Objects:
    """The store that a `files_url` names, checked by the settings; nothing is asked of it yet.

    Raise MissingExtraError where what speaks to it is not installed.
    """
    parts = urlsplit(url)
    if parts.scheme == "file":
        return Mounted(Path(unquote(parts.path)))
    need("s3fs", "cluster", "LIPSERVE_FILES_URL is set")
    from service.storage.files.bucket import Bucket  # noqa: PLC0415 - its library is an extra

    return Bucket(parts.netloc, parts.path.strip("/"))


class Mounted:
    """Objects are files below a folder, which has to be there: one that is not mounted is not made in its place."""

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
        """Copy an object into a new file; raise FileNotFoundError where there is none."""
        with _of_folder():
            try:
                shutil.copyfile(self.root / key, path)
            except FileNotFoundError:
                self.check()
                raise

    def delete(self, key: str) -> None:
        """Delete an object, and its folder below the first one where it was the last."""
        path = self.root / key
        with _of_folder():
            path.unlink(missing_ok=True)
            if path.parent.parent != self.root:
                try:
                    path.parent.rmdir()
                except OSError:  # not empty, or gone
                    return

    def list(self, prefix: str) -> Iterator[Entry]:
        """Objects whose keys begin so; what an interrupted `put` left is among them."""
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
        """See that the folder is there."""
        if not self.root.is_dir():
            raise unreachable(f"there is no folder {str(self.root)!r}: is it mounted?")


@contextmanager
def _of_folder() -> Iterator[None]:
    """Let errors of the folder be those of a store; a full disk stays one."""
    try:
        yield
    except (FileNotFoundError, FilesUnreachableError):
        raise
    except PermissionError:
        raise unreachable("access is denied: this user may not read and write the folder") from None
