"""The file store of the service: samples of data sets, folders of versions, snapshots of learning, uploads.

A file becomes visible when a database row names it. The row is written after the file is complete, below the home or in
the store that several services share.
"""

from __future__ import annotations

import hashlib
import logging
import os
import secrets
import shutil
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from sqlalchemy import select

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Samples
from lipcore.files import persistence
from lipcore.files.durable import make_folder
from lipcore.files.manifest import ModelFormatError
from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import DamagedDataError
from service.foundation.settings import Settings
from service.storage import sample_file
from service.storage.database import Database, DatasetRow, SnapshotRow, VersionRow
from service.storage.files import local
from service.storage.files.local import DamagedFileError, LocalFiles, remove
from service.storage.files.objects import FilesUnreachableError, RetryingStore, make_store
from service.storage.files.shared import SharedFiles
from service.storage.sample_file import ArrayOf, PartOf

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

PATIENCE_S = 60.0
"""Max time for which training retries an unreachable shared store before it fails, s."""


def new_id(prefix: str) -> str:
    """Return a new random id such as `ds_5f0c…`."""
    return f"{prefix}_{secrets.token_hex(8)}"


class Files:
    """The file store of one service. Ids come from `new_id`, never from a client. Safe from several threads.

    - home: of this service; uploads and publications always lie below it.
    - url: of the shared store, see `Settings.files_url`; None if all files lie below the home.
    - cache_bytes: max size of the cache of shared files.
    - patience_s: max time of retries if the store cannot be reached. Then methods raise FilesUnreachableError, an
      OSError.
    - read_only: write nothing to the home; for a store below the home only.
    - datasets, versions: folders below the home, of the files themselves or of copies, for tests and tools.

    Files that cannot be deleted in the store now are deleted at a start of a service, a day later or more.
    """

    def __init__(
        self,
        home: Path,
        url: str | None = None,
        cache_bytes: int = 4 << 30,
        patience_s: float = 0.0,
        read_only: bool = False,
    ) -> None:
        self.uploads, self.learning = home / "uploads", home / "learning"
        for folder in () if read_only else (self.uploads, self.learning):
            make_folder(folder)
        self._place: LocalFiles | SharedFiles
        if url is None:
            self._place = LocalFiles(home, read_only)
        else:
            objects = make_store(url)
            self._place = SharedFiles(home, RetryingStore(objects, patience_s) if patience_s else objects, cache_bytes)
        self.datasets, self.versions = self._place.datasets, self._place.versions

    @classmethod
    def of(cls, settings: Settings, patience_s: float = 0.0) -> Files:
        """Return the file store that the settings name."""
        return cls(settings.home, settings.files_url, settings.files_cache_bytes, patience_s)

    @classmethod
    @contextmanager
    def fresh(cls, settings: Settings, read_only: bool = False) -> Iterator[Files]:
        """Yield a store for verification: it reads no cached copy, and at most one file at a time needs space here."""
        files = cls(settings.home, settings.files_url, settings.files_cache_bytes, read_only=read_only)
        with files._place.fresh() as place:
            files._place = place
            yield files

    @property
    def shared(self) -> bool:
        """Return whether other services write to the same store."""
        return self._place.shared

    @property
    def folders(self) -> Mapping[str, Path]:
        """Folders on the disk of the home that grow, by their content."""
        return self._place.kinds

    def in_place(self) -> bool:
        """Return whether the folders of the home still exist: someone may have deleted them under a running service."""
        return all(each.is_dir() for each in (self.uploads, self.learning, *self.folders.values()))

    def write_samples(self, dataset: str, rows: int, n_joints: int, array: ArrayOf) -> str:
        """Store samples durably under a new id, one array after the other; return their sha256."""
        return self._place.write(_samples(dataset), lambda file: sample_file.write(file, rows, n_joints, array))

    def read_samples(
        self,
        dataset: str,
        joint_names: list[str],
        sha256: str,
        most: int | None = None,
        part: PartOf | None = None,
        joint_types: Sequence[str] | None = None,
    ) -> Samples:
        """Return the samples stored under `dataset`, or part of them, evenly thinned to `most`.

        joint_types: to include deflections; None for none. Raise DamagedDataError if the file is missing or changed.
        """
        path = self.samples_file(dataset, sha256)
        chosen = None
        if part is not None:
            episode, t = (sample_file.read_array(path, name) for name in ("episode", "t"))
            chosen = np.flatnonzero(part(episode, t))
        count = sample_file.count_rows(path) if chosen is None else len(chosen)
        if most is not None and count > most:
            thinned = spaced_rows(count, most)
            chosen = thinned if chosen is None else chosen[thinned]
        found = Samples(joint_names=tuple(joint_names), **sample_file.read(path, chosen))
        if joint_types is None:
            return found
        index = np.arange(count) if chosen is None else chosen
        return replace(found, deflections=sample_file.follow(sample_file.Reader(path), index, joint_types))

    def samples_file(self, dataset: str, sha256: str) -> Path:
        """Return the path of a data set's samples, see sample_file.py; raise DamagedDataError as `read_samples`.

        In a shared store it is a copy: open it within minutes. A later reader keeps it open, or calls this again.
        """
        try:
            return self._checked(_samples(dataset), sha256)
        except DamagedFileError as error:
            raise DamagedDataError(f"data set {dataset!r} is damaged: {error}. Upload it again") from error

    def keep_recording(self, dataset: str, upload: Path) -> None:
        """Store the uploaded file of a data set durably."""
        with upload.open("rb") as source:
            self._place.write(_recording(dataset), partial(shutil.copyfileobj, source))

    def recording(self, dataset: str, sha256: str) -> Path:
        """Return the path of the uploaded file of a data set; raise DamagedDataError. See `samples_file`."""
        try:
            return self._checked(_recording(dataset), sha256)
        except DamagedFileError as error:
            raise DamagedDataError(f"The file of data set {dataset!r} is damaged: {error}. Upload it again") from error

    def delete_dataset(self, dataset: str) -> None:
        """Delete samples and the uploaded file; do nothing if there are none."""
        with _forgiven():
            self._place.delete(_samples(dataset))
            self._place.delete(_recording(dataset))

    def write_snapshot(self, snapshot: str, payload: bytes) -> str:
        """Store the learnt state of a version durably under a new id; return its sha256."""
        self._place.write(_snapshot(snapshot), lambda file: file.write(payload))
        return hashlib.sha256(payload).hexdigest()

    def read_snapshot(self, snapshot: str, sha256: str | None = None) -> bytes:
        """Return the content of a snapshot; raise DamagedFileError unless it has the sha256, if given."""
        key = _snapshot(snapshot)
        path = self._place.file(key) if sha256 is None else self._checked(key, sha256)
        try:
            return path.read_bytes()
        except FileNotFoundError:
            raise DamagedFileError(f"{path.name} is missing") from None

    def delete_snapshot(self, snapshot: str) -> None:
        """Delete a snapshot; do nothing if there is none."""
        with _forgiven():
            self._place.delete(_snapshot(snapshot))

    def new_version(self, name: str) -> AbstractContextManager[Path]:
        """Yield the path of a folder for the block to create, as `lipcore.save` does; store it at the end of the block.

        If the block or storing fails, nothing is left. Write the row afterwards; if that fails, call `delete_version`.
        """
        return self._place.new_version(name)

    def version_folder(self, name: str) -> Path:
        """Return the folder of a version, for `lipcore.load` and the like, which report a missing one.

        In a shared store it is a copy that may be deleted after some minutes; `read_version` is safer.
        """
        return self._place.version(name)

    def read_version(self, name: str, read: Callable[[Path], Result]) -> Result:
        """Return the result of `read` on the folder of a version; raise ModelFormatError if that is damaged.

        A damaged or deleted copy is fetched again, once.
        """
        try:
            return _read_in(self._place.version(name), read)
        except ModelFormatError:
            if not self.shared:
                raise
        return _read_in(self._place.version(name, again=True), read)

    def load_version(self, name: str, checksums: Mapping[str, str] | None) -> TorqueModel:
        """Load a version, see `lipcore.load`; raise ModelFormatError if it is damaged or missing."""
        return self.read_version(name, lambda folder: persistence.load(folder, checksums))

    def has_version(self, name: str) -> bool:
        """Return whether the files of a version exist, without a request to a shared store."""
        return self._place.has_version(name)

    def delete_version(self, name: str) -> None:
        """Delete a version's files; raise OSError if the disk of the home refuses."""
        with _forgiven():
            self._place.delete_version(name)

    def versions_marked(self, mark: str, ended: bool = True) -> list[str]:
        """Return names of versions, complete or not, that begin with `mv_` and `mark`.

        ended: whether their job has ended. If not, versions of a shared store are left out: another service may be
        about to publish them.
        """
        return self._place.versions_marked(mark, ended)

    def upload(self) -> Path:
        """Create an empty temporary file for an upload and return its path; the caller deletes it."""
        handle, name = tempfile.mkstemp(dir=self.uploads)
        os.close(handle)
        return Path(name)

    def clear(self) -> int:
        """Delete unfinished uploads and downloads of an earlier run on this home; return their number."""
        left = [*self.uploads.iterdir(), *self._place.drafts()]
        for path in left:
            remove(path)
        return len(left)

    def sweep(self, datasets: Collection[str], versions: Collection[str], snapshots: Collection[str]) -> int:
        """Delete files that no row names, left by interrupted writes; return their number.

        In a shared store, only files that are a day old: other services are writing.
        """
        named = {key.partition("/")[2] for each in datasets for key in (_samples(each), _recording(each))}
        return self._place.sweep(named, versions, snapshots)

    def sweep_snapshots(self, named: Collection[str]) -> int:
        """Delete all snapshots but those named at once; return their number.

        It deletes none in a shared store, see `sweep`.
        """
        return self._place.sweep_snapshots(named)

    def check(self) -> None:
        """Check that a shared store answers within seconds; raise FilesUnreachableError. Do nothing without one."""
        self._place.check()

    def try_out(self) -> None:
        """Check that a shared store can be written, read and listed; raise OSError. Do nothing without one."""
        self._place.try_out()

    def _checked(self, key: str, sha256: str) -> Path:
        """Return the path of a file with this sha256; raise DamagedFileError."""
        path = self._place.file(key)
        try:
            local.check_sha256(path, sha256)
        except DamagedFileError:
            if not self.shared:
                raise
            path = self._place.file(key, again=True)  # the copy may be damaged, not the object
            local.check_sha256(path, sha256)
        return path


def _read_in(folder: Path, read: Callable[[Path], Result]) -> Result:
    """Return the result of `read` on a folder. An error about damage shows no path to the client."""
    try:
        return read(folder)
    except ModelFormatError as error:
        message = str(error).replace(f"{folder}/", "").replace(str(folder), "its folder")
        raise ModelFormatError(message, error.file) from error


@contextmanager
def _forgiven() -> Iterator[None]:
    """Ignore files that a shared store cannot delete now: they are swept later."""
    try:
        yield
    except FilesUnreachableError as error:
        logger.warning("could not delete a file of the shared store; the next sweep will: %s", error.strerror)


def _samples(dataset: str) -> str:
    return f"datasets/{dataset}.safetensors"


def _recording(dataset: str) -> str:
    return f"datasets/{dataset}.recording"


def _snapshot(snapshot: str) -> str:
    return f"learning/{snapshot}.safetensors"


def start_sweeping(database: Database, files: Files) -> None:
    """Delete files that no row names: before the service starts, or in a thread if the store is shared.

    Listing a large store takes minutes, and the service may be needed at once.
    """
    if cleared := files.clear():
        logger.warning("removed %d unfinished uploads of an earlier run", cleared)
    if files.shared:
        threading.Thread(target=_beside, args=(database, files), name="sweep", daemon=True).start()
    else:
        sweep_unnamed(database, files)


def sweep_unnamed(database: Database, files: Files) -> int:
    """Delete files that no row names; return their number."""
    with database.session() as session:
        datasets = set(session.scalars(select(DatasetRow.id)))
        versions = set(session.scalars(select(VersionRow.folder)))
        snapshots = set(session.scalars(select(SnapshotRow.id)))
    swept = files.sweep(datasets, versions, snapshots)
    if swept:
        logger.warning("removed %d unfinished files of an earlier run", swept)
    return swept


def _beside(database: Database, files: Files) -> None:
    try:
        sweep_unnamed(database, files)
    except Exception as error:  # retried at the next start
        logger.warning("could not delete files of interrupted writes: %s", error)
