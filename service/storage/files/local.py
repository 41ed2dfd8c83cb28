"""Files that outlive a power cut, whole or not at all; and those below the home of the only service that there is."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from lipcore.files.durable import make_folder, sync
from service.storage import sample_file

Result = TypeVar("Result")


class DamagedFileError(ValueError):
    """A file does not have the sha256 that was kept of it, or is not there."""


def check_sha256(path: Path, sha256: str) -> None:
    """Raise DamagedFileError unless a file is there and has this sha256."""
    try:
        digest = sample_file.sha256(path)
    except FileNotFoundError:
        raise DamagedFileError(f"{path.name} is missing") from None
    if digest != sha256:
        raise DamagedFileError(f"{path.name} does not have the sha256 that was kept of it")


def write_durably(path: Path, write: Callable[[IO[bytes]], Result], draft: Path | None = None) -> Result:
    """Write a file that outlives a power cut, whole or not at all; return what `write` does.

    draft: what it is called until it is whole; beside it by default.
    """
    draft = path.with_suffix(".draft") if draft is None else draft
    try:
        with draft.open("wb") as file:
            result = write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except (OSError, ValueError):
        draft.unlink(missing_ok=True)  # on a full disk, room for what comes next
        raise
    sync(path.parent)  # the new name, before a row tells of it
    return result


class Local:
    """Keys name files: `datasets/ds_1.safetensors` lies there below the home, for good.

    shared: whether other services write too.
    """

    shared = False

    def __init__(self, home: Path) -> None:
        self._home = home
        self.datasets, self.versions, self.snapshots = home / "datasets", home / "versions", home / "learning"
        for folder in (self.datasets, self.versions, self.snapshots):
            make_folder(folder)

    @property
    def kinds(self) -> Mapping[str, Path]:
        """Folders on the disk of the home, by what is in them."""
        return {"datasets": self.datasets, "versions": self.versions, "snapshots": self.snapshots}

    def file(self, key: str, again: bool = False) -> Path:
        """Where a file lies, or would; raise FileNotFoundError where its folder is gone: that is no damaged file."""
        return _in_place(self._home / key)

    def write(self, key: str, write: Callable[[IO[bytes]], Result]) -> Result:
        """Store a file durably, whole or not at all; return what `write` does."""
        return write_durably(self._home / key, write)

    def delete(self, key: str) -> None:
        """Delete a file; nothing happens where there is none."""
        (self._home / key).unlink(missing_ok=True)

    def version(self, name: str, again: bool = False) -> Path:
        """Folder of a version; raise as `file` does."""
        return _in_place(self.versions / name)

    def has_version(self, name: str) -> bool:
        """Whether the files of a version are there, as far as can be told at once."""
        return (self.versions / name / "manifest.json").is_file()

    @contextmanager
    def new_version(self, name: str) -> Iterator[Path]:
        """Give a folder to be made, and written durably, in the block; where that fails, nothing is left of it."""
        folder = self.versions / name
        try:
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def delete_version(self, name: str) -> None:
        """Delete a version's folder; raise FileNotFoundError where there is none."""
        shutil.rmtree(self.versions / name)

    def versions_marked(self, mark: str, ended: bool = True) -> list[str]:
        """Names of folders of versions, and of drafts of such, that have `mark` in them."""
        return [path.name for path in self.versions.glob(f"*{mark}*") if path.is_dir()]

    def drafts(self) -> Iterable[Path]:
        """What earlier processes had begun to write elsewhere than at its place: nothing."""
        return ()

    def sweep(self, datasets: Collection[str], versions: Collection[str], snapshots: Collection[str]) -> int:
        """Delete what is none of these; return how many."""
        left = [path for path in self.datasets.iterdir() if path.name.removesuffix(".safetensors") not in datasets]
        left += [path for path in self.versions.iterdir() if path.name not in versions]
        for path in left:
            remove(path)
        return len(left) + self.sweep_snapshots(snapshots)

    def sweep_snapshots(self, named: Collection[str]) -> int:
        """Delete all snapshots but those named; return how many."""
        stored = (path for path in self.snapshots.iterdir() if path.is_file())
        left = [path for path in stored if path.name.removesuffix(".safetensors") not in named]
        for path in left:
            remove(path)
        return len(left)

    @contextmanager
    def fresh(self) -> Iterator[Local]:
        """What reads no copies: this, which has none."""
        yield self

    def check(self) -> None:
        """Nothing: the home is looked at by others."""

    def try_out(self) -> None:
        """Nothing, as `check`."""


def _in_place(path: Path) -> Path:
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    return path


def remove(path: Path) -> None:
    """Delete a file or a folder with all that is in it."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
