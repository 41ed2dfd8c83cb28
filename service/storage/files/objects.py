"""Stores of whole objects that several services share: a bucket, or a folder that all hosts mount.

An object is immutable, and there whole or not at all. Keys are relative: `datasets/ds_1.safetensors`, as below a home.
"""

from __future__ import annotations

import builtins
import errno
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar
from urllib.parse import unquote, urlsplit

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 8.0
"""Pauses before a store is asked again: each time twice as long."""


class FilesUnreachableError(OSError):
    """The shared store cannot be reached or used now; nothing was stored. Made by `unreachable`."""


def unreachable(reason: str) -> FilesUnreachableError:
    """The error for a store that cannot be used; reason: for people, without addresses and secrets."""
    return FilesUnreachableError(errno.EIO, f"the shared files: {reason}")


class Found(NamedTuple):
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

    def list(self, prefix: str) -> Iterator[Found]:
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

    def list(self, prefix: str) -> Iterator[Found]:
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
            pause = min(2 * pause, LONGEST_PAUSE_S)


def store_of(url: str) -> Objects:
    """The store that a `files_url` names, checked by the settings; nothing is asked of it yet.

    Raise FilesUnreachableError where what speaks to it is not installed.
    """
    parts = urlsplit(url)
    if parts.scheme == "file":
        from service.storage.files.mounted import Mounted  # noqa: PLC0415 - one of the two is needed

        return Mounted(Path(unquote(parts.path)))
    try:
        from service.storage.files.bucket import Bucket  # noqa: PLC0415 - its library is an extra
    except ImportError as error:
        raise unreachable(f"{error.name or 'a library'} is not installed: pip install 'lipserve[cluster]'") from None
    return Bucket(parts.netloc, parts.path.strip("/"))
