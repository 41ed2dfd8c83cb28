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
from pathlib import Path

import numpy as np
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from lipcore.samples import Samples
from service.errors import DamagedDataError

ARRAYS = ("t", "episode", "q", "dq", "ddq", "tau")


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

    def write_samples(self, dataset: str, samples: Samples) -> str:
        """Store samples durably under a new id; return their sha256."""
        payload = save_arrays({name: np.ascontiguousarray(getattr(samples, name)) for name in ARRAYS})
        _write(self.datasets / f"{dataset}.safetensors", payload)
        return hashlib.sha256(payload).hexdigest()

    def read_samples(self, dataset: str, joint_names: list[str], sha256: str) -> Samples:
        """Read samples stored under `dataset`; raise DamagedDataError unless they are those that were stored."""
        try:
            payload = _read(self.datasets / f"{dataset}.safetensors", sha256)
        except DamagedFileError as error:
            raise DamagedDataError(f"data set {dataset!r} is damaged: {error}. Upload it again") from error
        return Samples(joint_names=tuple(joint_names), **load_arrays(payload))

    def delete_samples(self, dataset: str) -> None:
        """Delete samples; nothing happens where there are none."""
        (self.datasets / f"{dataset}.safetensors").unlink(missing_ok=True)

    def write_snapshot(self, snapshot: str, payload: bytes) -> str:
        """Store what a version has learnt durably under a new id; return its sha256."""
        _write(self.learning / f"{snapshot}.safetensors", payload)
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
    try:
        payload = path.read_bytes()
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing") from None
    if sha256 is not None and hashlib.sha256(payload).hexdigest() != sha256:
        raise DamagedFileError(f"{path} does not have the sha256 that was kept of it")
    return payload


def _write(path: Path, payload: bytes) -> None:
    """Write a file that outlives a power cut, whole or not at all."""
    draft = path.with_suffix(".draft")
    try:
        with draft.open("wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except OSError:
        draft.unlink(missing_ok=True)  # on a full disk, room for what comes next
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name, before a row tells of it
    finally:
        os.close(folder)
