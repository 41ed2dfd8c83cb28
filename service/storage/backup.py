"""Backup of a home in one file, as of one moment, beside the service that writes to it; and its restore.

Rows decide which files exist: a file is complete before its row is committed, and deleted only after the row. So while
no transaction can commit, every row has its file. Most files are copied before that, without any lock. Then writers
wait for milliseconds: the few new files are opened, and a read transaction pins the database's state. SQLite's online
backup copies that state afterwards. Files that are deleted after this moment are still open here.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sqlite3
import tarfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any
from urllib.parse import quote

from lipcore.files.durable import sync_folder
from service import __version__
from service.storage.database import now
from service.storage.database.engine import FILE, PATIENCE_S
from service.storage.files.local import remove, write_durably
from service.storage.storage import HomeError, lock_home

FORMAT, FORMAT_VERSION = "lipserve-backup", 1
MANIFEST = "backup.json"
"""The last member of the archive: data about the moment, and size and sha256 of each file."""
MAX_ROUNDS = 20
LOCK = ".lock"
_NAMES = re.compile(
    rf"{re.escape(FILE)}|{re.escape(MANIFEST)}|(datasets|learning)/[a-z]+_\w{{1,36}}\.(safetensors|recording)"
    r"|versions/mv_\w{1,36}/[a-z][\w.-]{0,40}",
    re.ASCII,
)
_KINDS = {
    "datasets": "SELECT 'datasets/' || id || '.safetensors' FROM datasets",
    "versions": "SELECT 'versions/' || folder FROM versions",
    "snapshots": "SELECT 'learning/' || id || '.safetensors' FROM snapshots",
}
"""Queries of the files and folders that rows name; the columns are the same in every release."""
_RECORDINGS = (
    "SELECT 'datasets/' || id || '.recording' FROM datasets WHERE json_extract(report, '$.upload_options') IS NOT NULL"
)
"""Query of the uploaded files of data sets; earlier releases kept none."""


class BackupError(ValueError):
    """A file is no backup or is damaged, or the home to copy is damaged."""


@dataclass(frozen=True)
class Backup:
    """Content of a backup. Fields without a docstring are numbers of rows."""

    at: str
    """Time of the backup, ISO 8601 in UTC."""
    size: int
    """Bytes of its files."""
    datasets: int
    versions: int
    snapshots: int
    observations: int


def backup(home: Path, file: Path) -> Backup:
    """Copy a home into a new file, durably and whole or not at all, with the commits up to one moment.

    Raise FileNotFoundError if the home has no database, FileExistsError if the file exists, BackupError if a file of
    the home is missing. Errors of SQLite and the disks are raised too.
    """
    if not (home / FILE).is_file():
        raise FileNotFoundError(f"home is {str(home)!r}, expected a folder with the database of a service")
    if file.exists():
        raise FileExistsError(f"file is {str(file)!r}, expected a new file: this one exists already")
    draft = file.with_name(f"{file.name}.draft")
    draft.unlink(missing_ok=True)
    draft.touch(0o600)  # the database contains hashes of keys
    try:
        return write_durably(file, lambda opened: _write(home, opened, file.parent), draft)
    finally:
        draft.unlink(missing_ok=True)


def _write(home: Path, opened: IO[bytes], folder: Path) -> Backup:
    with (
        tarfile.open(mode="w|", fileobj=opened, format=tarfile.GNU_FORMAT) as tar,
        closing(_connected(home / FILE)) as reader,
        TemporaryDirectory(prefix=".backup-", dir=folder) as scratch,
    ):
        sums = dict[str, dict[str, Any]]()
        for _ in range(MAX_ROUNDS):  # the first round copies nearly all files, the next ones the new files
            pending = [key for key in _named(reader) if not _has(sums, key)]
            for key in pending:
                with _files(home, [key], missing_ok=True) as files:
                    _add(tar, files, sums)
            if len(pending) <= 50:  # the rest is copied while writers wait
                break
        with ExitStack() as held:
            with closing(_connected(home / FILE)) as lock:
                lock.execute("BEGIN IMMEDIATE")  # from here on nothing is committed, so nothing is deleted either
                reader.execute("BEGIN")
                keys, at = _named(reader), now()  # the reader stays at this state
                held.callback(reader.rollback)
                files = held.enter_context(_files(home, [key for key in keys if not _has(sums, key)]))
            _add(tar, files, sums)
            counts = _counts(reader)
            copy = Path(scratch) / FILE
            with closing(sqlite3.connect(copy)) as target:
                reader.backup(target)
        with copy.open("rb") as database:
            _add(tar, {FILE: database}, sums)
        of_moment = {name: each for name, each in sums.items() if name == FILE or _key(name) in keys}
        about = {"format": FORMAT, "format_version": FORMAT_VERSION, "software": __version__, "at": at}
        text = json.dumps(about | {"files": of_moment}, indent=1).encode()
        _add(tar, {MANIFEST: BytesIO(text)}, {}, len(text))
        return Backup(at, sum(each["size"] for each in of_moment.values()), **counts)


def _connected(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{quote(str(path))}?mode=rw", PATIENCE_S, isolation_level=None, uri=True)


def _named(reader: sqlite3.Connection) -> set[str]:
    return {key for query in (*_KINDS.values(), _RECORDINGS) for (key,) in reader.execute(query)}


def _counts(reader: sqlite3.Connection) -> dict[str, int]:
    """Return the number of rows, by the fields of `Backup`."""
    queries = {**_KINDS, "observations": "SELECT number FROM events WHERE kind = 'batch'"}
    return {kind: sum(1 for _ in reader.execute(query)) for kind, query in queries.items()}


def _key(name: str) -> str:
    """Return the name of a file in rows: its own, or the folder of a version."""
    return "/".join(name.split("/")[:2])


def _has(sums: Iterable[str], key: str) -> bool:
    return key in sums or f"{key}/manifest.json" in sums


@contextmanager
def _files(home: Path, keys: Iterable[str], missing_ok: bool = False) -> Iterator[dict[str, IO[bytes]]]:
    """Yield the open files of keys by name; raise BackupError for a missing one, or leave it out if `missing_ok`."""
    with ExitStack() as opened:
        files = dict[str, IO[bytes]]()
        for key in keys:
            try:
                path = home / key
                names = [f"{key}/{name}" for name in sorted(os.listdir(path))] if path.is_dir() else [key]
                files |= {name: opened.enter_context((home / name).open("rb")) for name in names}
            except FileNotFoundError:
                if not missing_ok:
                    message = f"{key} is missing below {home}: `lipserve verify` lists all damage"
                    raise BackupError(message) from None
        yield files


def _add(
    tar: tarfile.TarFile, files: dict[str, IO[bytes]], sums: dict[str, dict[str, Any]], size: int | None = None
) -> None:
    """Write files to the archive, and add size and sha256 of each to `sums`."""
    for name, file in files.items():
        info = tarfile.TarInfo(name)
        info.size = os.fstat(file.fileno()).st_size if size is None else size
        info.mode = 0o600
        read = _HashingReader(file)
        tar.addfile(info, read)
        sums[name] = {"size": info.size, "sha256": read.digest.hexdigest()}


class _HashingReader:
    """A file that hashes the bytes read from it."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.digest = file, hashlib.sha256()

    def read(self, count: int = -1) -> bytes:
        piece = self.file.read(count)
        self.digest.update(piece)
        return piece


def restore(home: Path, file: Path) -> Backup:
    """Create a home from a backup. A failed restore leaves nothing.

    The database is written last, so that after a power cut a service finds no database in a partly restored home. Raise
    HomeError unless the home is empty or missing, and unused; BackupError if the file is no backup or is damaged.
    """
    with file.open("rb") as opened, lock_home(home):
        if any(path.name != LOCK for path in home.iterdir()):
            raise HomeError(f"home is {str(home)!r}, expected an empty folder, as nothing is overwritten")
        try:
            return _restored(home, opened)
        except BaseException:
            for path in home.iterdir():
                if path.name != LOCK:
                    remove(path)
            raise


def _restored(home: Path, opened: IO[bytes]) -> Backup:
    draft, sums, about = home / f"{FILE}.draft", dict[str, dict[str, Any]](), dict[str, Any]()
    try:
        with tarfile.open(mode="r|", fileobj=opened) as tar:
            for info in tar:
                name, content = info.name, tar.extractfile(info) if info.isreg() else None
                if content is None or info.issparse() or not _NAMES.fullmatch(name) or name in sums:
                    raise BackupError(f"the file is no backup: it has the unexpected or repeated entry {name[:200]!r}")
                if name == MANIFEST:
                    about = json.loads(content.read())
                    continue
                path = draft if name == FILE else home / name
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                sums[name] = {"size": info.size, "sha256": _extract(content, path)}
    except (tarfile.TarError, EOFError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BackupError(f"the file is not a backup, or it is damaged: {error}") from error
    _check(about, sums)
    for key in {_key(name) for name in sums.keys() - about["files"].keys()}:  # deleted while the backup was made
        remove(home / key)
    with closing(sqlite3.connect(f"file:{quote(str(draft))}?mode=ro&immutable=1", uri=True)) as database:
        faults = [fault for (fault,) in database.execute("PRAGMA quick_check(1)")]
        counts = _counts(database)
        lacking = [key for key in _named(database) if not _has(sums, key)]
    if faults != ["ok"] or lacking:
        raise BackupError(f"the file is damaged: {', '.join(lacking) + ' is missing' if lacking else faults[0]}")
    for folder in {(home / name).parent for name in sums} | {home / "versions", home}:
        if folder.is_dir():
            sync_folder(folder)
    draft.rename(home / FILE)
    sync_folder(home)
    return Backup(about["at"], sum(each["size"] for each in about["files"].values()), **counts)


def _extract(content: IO[bytes], path: Path) -> str:
    digest = hashlib.sha256()
    path.touch(0o600)
    with path.open("wb") as file:
        while piece := content.read(1 << 20):
            file.write(piece)
            digest.update(piece)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest()


def _check(about: Any, sums: dict[str, dict[str, Any]]) -> None:
    """Raise BackupError unless all files of the manifest are there and unchanged."""
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise BackupError(f"the file is not a backup, or it is incomplete: {MANIFEST} is missing at its end")
    if about.get("format_version") != FORMAT_VERSION:
        message = f"the backup has format_version {about.get('format_version')!r}, expected {FORMAT_VERSION}"
        raise BackupError(f"{message}: it was made by a later release of LIPServe")
    files = about.get("files")
    if not isinstance(files, dict):
        raise BackupError(f"the backup is damaged: {MANIFEST} lists no files")
    for name, known in {FILE: None, **files}.items():
        if sums.get(name) != known or known is None:
            raise BackupError(f"the backup is damaged: {name} does not match {MANIFEST}")
