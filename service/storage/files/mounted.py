"""A folder that all hosts mount as a store of objects, such as NFS."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.storage.files import durable
from service.storage.files.objects import FilesUnreachableError, Found, unreachable

DRAFT = ".draft-"


class Mounted:
    """Objects are files below a folder, which has to be there: one that is not mounted is not made in its place."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def put(self, path: Path, key: str) -> None:
        """Store a file durably."""
        target = self.root / key
        with _told():
            self.check()
            target.parent.mkdir(parents=True, exist_ok=True)
            with path.open("rb") as file:
                draft = target.parent / f"{DRAFT}{secrets.token_hex(8)}"
                durable.store(target, lambda out: shutil.copyfileobj(file, out, 1 << 20), draft)

    def get(self, key: str, path: Path) -> None:
        """Copy an object into a new file; raise FileNotFoundError where there is none."""
        with _told():
            try:
                shutil.copyfile(self.root / key, path)
            except FileNotFoundError:
                self.check()
                raise

    def delete(self, key: str) -> None:
        """Delete an object, and its folder below the first one where it was the last."""
        path = self.root / key
        with _told():
            path.unlink(missing_ok=True)
            if path.parent.parent != self.root:
                try:
                    path.parent.rmdir()
                except OSError:  # not empty, or gone
                    return

    def list(self, prefix: str) -> Iterator[Found]:
        """Objects whose keys begin so; what an interrupted `put` left is among them."""
        parent, _, beginning = prefix.rpartition("/")
        with _told():
            self.check()
            folder = self.root / parent
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if path.name.startswith(beginning):
                    yield from self._below(path)

    def _below(self, path: Path) -> Iterator[Found]:
        for each in path.iterdir() if path.is_dir() else [path]:
            with suppress(FileNotFoundError):  # deleted meanwhile
                yield Found(each.relative_to(self.root).as_posix(), each.stat().st_mtime)

    def check(self) -> None:
        """See that the folder is there."""
        if not self.root.is_dir():
            raise unreachable(f"there is no folder {str(self.root)!r}: is it mounted?")


@contextmanager
def _told() -> Iterator[None]:
    """Let errors of the folder be those of a store; a full disk stays one."""
    try:
        yield
    except (FileNotFoundError, FilesUnreachableError):
        raise
    except PermissionError:
        raise unreachable("access is denied: this user may not read and write the folder") from None
