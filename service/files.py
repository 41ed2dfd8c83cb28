"""Files of the service below its home: samples of data sets, folders of model versions, snapshots of what was learnt,
uploads in progress.

A file is visible only once a database row names it, and the row is written after the file is complete.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, TypeVar

import numpy as np

from lipcore.samples import Samples
from service import sample_file
from service.errors import DamagedDataError
from service.sample_file import ArrayOf, PartOf
from service.settings import Settings

Result = TypeVar("Result")


class DamagedFileError(ValueError):
    """A file does not have the sha256 that was kept of it, or is not there."""


def new_id(prefix: str) -> str:
    """Return a fresh random id such as `ds_5f0c…`."""
    return f"{prefix}_{secrets.token_hex(8)}"


class Files:
    """The file store of one service. Ids come from `new_id`, never from a client."""

    def __init__(self, home: Path) -> None:
        self.datasets, self.versions, self.uploads = home / "datasets", home / "versions", home / "uploads"
        self.learning = home / "learning"
        for folder in (self.datasets, self.versions, self.uploads, self.learning):
            folder.mkdir(parents=True, exist_ok=True)

    @classmethod
    def of(cls, settings: Settings) -> Files:
        """The file store that the settings name."""
        return cls(settings.home)

    def write_samples(self, dataset: str, rows: int, n_joints: int, array: ArrayOf) -> str:
        """Store samples durably under a new id, asking for one array after the other; return their sha256."""
        target = self.datasets / f"{dataset}.safetensors"
        return _store(target, lambda file: sample_file.write(file, rows, n_joints, array))

    def read_samples(
        self, dataset: str, joint_names: list[str], sha256: str, most: int | None = None, part: PartOf | None = None
    ) -> Samples:
        """Read samples stored under `dataset`, or part of them, evenly thinned to `most`.

        Raise DamagedDataError unless they are those that were stored.
        """
        path = self.samples_file(dataset, sha256)
        chosen = None
        if part is not None:
            episode, t = (sample_file.read_array(path, name) for name in ("episode", "t"))
            chosen = np.flatnonzero(part(episode, t))
        count = sample_file.rows_of(path) if chosen is None else len(chosen)
        if most is not None and count > most:
            thinned = np.linspace(0, count - 1, most).round().astype(np.int64)
            chosen = thinned if chosen is None else chosen[thinned]
        return Samples(joint_names=tuple(joint_names), **sample_file.read(path, chosen))

    def samples_file(self, dataset: str, sha256: str) -> Path:
        """Where the samples of a data set lie, see sample_file.py; raise DamagedDataError as `read_samples`."""
        path = self.datasets / f"{dataset}.safetensors"
        try:
            _check(path, sha256)
        except DamagedFileError as error:
            raise DamagedDataError(f"data set {dataset!r} is damaged: {error}. Upload it again") from error
        return path

    def delete_samples(self, dataset: str) -> None:
        """Delete samples; nothing happens where there are none."""
        (self.datasets / f"{dataset}.safetensors").unlink(missing_ok=True)

    def write_snapshot(self, snapshot: str, payload: bytes) -> str:
        """Store what a version has learnt durably under a new id; return its sha256."""
        target = self.learning / f"{snapshot}.safetensors"
        _store(target, lambda file: file.write(payload))
        return hashlib.sha256(payload).hexdigest()

    def read_snapshot(self, snapshot: str, sha256: str | None = None) -> bytes:
        """Read what is stored under `snapshot`; raise DamagedFileError unless it has the sha256, where known."""
        return _read(self.learning / f"{snapshot}.safetensors", sha256)

    def delete_snapshot(self, snapshot: str) -> None:
        """Delete a snapshot; nothing happens where there is none."""
        (self.learning / f"{snapshot}.safetensors").unlink(missing_ok=True)

    def upload(self) -> Path:
        """Create an empty temporary file for an upload; the caller deletes it."""
        handle, name = tempfile.mkstemp(dir=self.uploads)
        os.close(handle)
        return Path(name)

    def sweep(self, datasets: set[str], versions: set[str], snapshots: set[str]) -> int:
        """Delete what an interrupted write left: files that no row names. Return how many."""
        left = list(self.uploads.iterdir())
        left += [path for path in self.datasets.iterdir() if path.name.removesuffix(".safetensors") not in datasets]
        left += [path for path in self.versions.iterdir() if path.name not in versions]
        stored = (path for path in self.learning.iterdir() if path.is_file())
        left += [path for path in stored if path.name.removesuffix(".safetensors") not in snapshots]
        for path in left:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return len(left)


def _read(path: Path, sha256: str | None) -> bytes:
    """A stored file; raise DamagedFileError where it is another one than was stored, or none."""
    if sha256 is not None:
        _check(path, sha256)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing") from None


def _check(path: Path, sha256: str) -> None:
    try:
        found = sample_file.sha256(path)
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing") from None
    if found != sha256:
        raise DamagedFileError(f"{path} does not have the sha256 that was kept of it")


def _store(path: Path, write: Callable[[IO[bytes]], Result]) -> Result:
    """Write a file that outlives a power cut, whole or not at all; return what `write` does."""
    draft = path.with_suffix(".draft")
    try:
        with draft.open("wb") as file:
            result = write(file)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except (OSError, ValueError):
        draft.unlink(missing_ok=True)  # on a full disk, room for what comes next
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name, before a row tells of it
    finally:
        os.close(folder)
    return result
