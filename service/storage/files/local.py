"""Durable files that are written whole or not at all; and the files below the home of a single service."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from lipcore.files.durable import make_folder, sync_folder
from service.storage import sample_file

Result = TypeVar("Result")


class DamagedFileError(ValueError):
    """A file is missing, or does not have its stored sha256."""


def check_sha256(path: Path, sha256: str) -> None:
    """Raise DamagedFileError unless a file exists and has this sha256."""
    try:
        digest = sample_file.sha256(path)
    except FileNotFoundError:
        raise DamagedFileError(f"{path.name} is missing") from None
    if digest != sha256:
        raise DamagedFileError(f"{path.name} does not match its stored sha256")


def write_durably(path: Path, write: Callable[[IO[bytes]], Result], draft: Path | None = None) -> Result:
    """Write a file that survives a power cut, whole or not at all; return the result of `write`.

    draft: path of the unfinished file; by default in the same folder.
    """
    draft = path.with_suffix(".draft") if draft is None else draft
    try:
        with draft.open("wb") as file:
            result = write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except (OSError, ValueError):
        draft.unlink(missing_ok=True)  # frees space on a full disk
        raise
    sync_folder(path.parent)  # syncs the new name before a row refers to it
    return result


class LocalFiles:
    """Files below the home: `datasets/ds_1.safetensors` is both a key and a path.

    shared: whether other services write too.
    """

    shared = False

    def __init__(self, home: Path, read_only: bool = False) -> None:
        self._home = home
        self.datasets, self.versions, self.snapshots = home / "datasets", home / "versions", home / "learning"
        for folder in () if read_only else (self.datasets, self.versions, self.snapshots):
            make_folder(folder)

    @property
    def kinds(self) -> Mapping[str, Path]:
        """Folders on the disk of the home, by their content."""
        return {"datasets": self.datasets, "versions": self.versions, "snapshots": self.snapshots}

    def file(self, key: str, again: bool = False) -> Path:
        """Return the path of a file, which may not exist.

        Raise FileNotFoundError if its folder is missing; this is no damaged file.
        """
        return _in_place(self._home / key)

    def write(self, key: str, write: Callable[[IO[bytes]], Result]) -> Result:
        """Store a file durably, whole or not at all; return the result of `write`."""
        return write_durably(self._home / key, write)

    def delete(self, key: str) -> None:
        """Delete a file; do nothing if there is none."""
        (self._home / key).unlink(missing_ok=True)

    def version(self, name: str, again: bool = False) -> Path:
        """Return the folder of a version; raise as `file` does."""
        return _in_place(self.versions / name)

    def has_version(self, name: str) -> bool:
        """Return whether the files of a version exist, by its manifest."""
        return (self.versions / name / "manifest.json").is_file()

    @contextmanager
    def new_version(self, name: str) -> Iterator[Path]:
        """Yield a folder for the block to create durably; delete it if the block fails."""
        folder = self.versions / name
        try:
            yield folder
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def delete_version(self, name: str) -> None:
        """Delete a version's folder; raise FileNotFoundError if there is none."""
        shutil.rmtree(self.versions / name)

    def versions_marked(self, mark: str, ended: bool = True) -> list[str]:
        """Return names of version folders, and of their drafts, that contain `mark`."""
        return [path.name for path in self.versions.glob(f"*{mark}*") if path.is_dir()]

    def drafts(self) -> Iterable[Path]:
        """Return nothing: drafts lie beside their files."""
        return ()

    def sweep(self, datasets: Collection[str], versions: Collection[str], snapshots: Collection[str]) -> int:
        """Delete all files but those of these names, and snapshots; return the number of deleted ones."""
        left = [path for path in self.datasets.iterdir() if path.name not in datasets]
        left += [path for path in self.versions.iterdir() if path.name not in versions]
        for path in left:
            remove(path)
        return len(left) + self.sweep_snapshots(snapshots)

    def sweep_snapshots(self, named: Collection[str]) -> int:
        """Delete all snapshots but those named; return the number of deleted ones."""
        stored = (path for path in self.snapshots.iterdir() if path.is_file())
        left = [path for path in stored if path.name.removesuffix(".safetensors") not in named]
        for path in left:
            remove(path)
        return len(left)

    @contextmanager
    def fresh(self) -> Iterator[LocalFiles]:
        """Yield these files: there is no cache to avoid."""
        yield self

    def check(self) -> None:
        """Do nothing: `probe_home` of `service.storage.storage` checks the home."""

    def try_out(self) -> None:
        """Do nothing, as `check`."""


def _in_place(path: Path) -> Path:
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    return path


def remove(path: Path) -> None:
    """Delete a file, or a folder with its content."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
