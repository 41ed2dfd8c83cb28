"""`lipserve verify`: check everything that a home stores."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple, get_args

import typer
from rich.markup import escape
from sqlalchemy import select
from sqlalchemy.orm import Session, undefer
from threadpoolctl import threadpool_limits

import lipcore
from lipcore.files import persistence
from lipcore.files.probing import probe
from lipcore.online import transfer as state
from service.cli.consoles import echo, err, print_json
from service.cli.options import Json, alone, settings_of
from service.foundation.errors import DamagedDataError
from service.foundation.settings import Settings
from service.foundation.text import counted
from service.journal.floor import error_floor_of
from service.journal.log import EventKind, decode
from service.journal.recompute import check_same, find_gap, recompute, state_as_trained
from service.journal.restore import RestoredState, restore
from service.learning.owner import read_options
from service.models import registry
from service.runtime.process import SERVING_THREADS
from service.storage.database import Database, DatasetRow, EventRow, RobotRow, ServingRow, SnapshotRow, VersionRow
from service.storage.database.engine import FILE
from service.storage.database.readonly import ReadOnlySqlite, is_read_only
from service.storage.files import Files, FilesUnreachableError
from service.storage.storage import WAIT_S, HomeError, explain_home_errors


class Damage(NamedTuple):
    """Stored item that cannot be used, and the reason."""

    kind: str
    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name}: {self.reason}"


@dataclass
class Verified:
    """Number of items read, by kind, and those that are damaged."""

    read: dict[str, int] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)

    def document(self) -> dict[str, Any]:
        """Return the findings for JSON."""
        return {"read": self.read, "damaged": [each._asdict() for each in self.damages]}


def verify_home(settings: Settings) -> Verified:
    """Read all that a home stores, and recompute from the logs what its models have learnt.

    It may run beside the service: an item that the service deletes meanwhile does not count as damaged. Nothing is
    changed, except that a database of an earlier release is migrated. A home may be read-only. If services share a
    database and files, those are read, not local copies.

    Raises:
        DatabaseVersionError: The database needs a migration, and the home is read-only.
        FileNotFoundError: The home has no database.
        FilesUnreachableError: The shared files cannot be read now.
    """
    if settings.database_url is None and not (settings.home / FILE).is_file():
        raise FileNotFoundError(
            f"home is {str(settings.home)!r}, expected a folder with the database of a service: set LIPSERVE_HOME"
        )
    threadpool_limits(SERVING_THREADS)
    read_only = settings.database_url is None and is_read_only(settings.home)
    adapter = ReadOnlySqlite(settings.home, WAIT_S) if read_only else None
    database = Database(settings.home, WAIT_S, settings.database_url, settings.database_connections, adapter)
    try:
        with Files.fresh(settings, read_only) as files:
            return _verify(database, files)
    finally:
        database.close()


def _verify(database: Database, files: Files) -> Verified:
    findings = Verified()
    findings.damages += [Damage("database", FILE, each) for each in database.adapter.inconsistencies(20)]
    is_damaged = bool(findings.damages)
    for kind, check in _CHECKS.items():
        findings.read[kind] = 0
        try:
            _check(database, kind, check(database, files), findings)
        except Exception:  # rows of a damaged database may contain anything
            if not is_damaged:
                raise
    return findings


def _check(database: Database, kind: str, found: Iterator[_Finding], findings: Verified) -> None:
    for name, gone, reason in found:
        findings.read[kind] += 1
        if reason is None:
            continue
        with database.session() as session:
            if not gone(session):
                findings.damages.append(Damage(kind.removesuffix("s"), name, reason))


_Finding = tuple[str, Callable[[Session], bool], str | None]
"""Name of an item, a check whether it was deleted meanwhile, and its damage (None if it is intact)."""


def _datasets(database: Database, files: Files) -> Iterator[_Finding]:
    with database.session() as session:
        rows = list(session.scalars(select(DatasetRow)))
    for row in rows:
        yield row.id, _deletion_check(DatasetRow, row.seq), _reason(_read_dataset, files, row)


def _read_dataset(files: Files, row: DatasetRow) -> None:
    samples = files.read_samples(row.id, row.joint_names, row.sha256)
    if len(samples) != row.rows:
        raise ValueError(f"the file has {len(samples)} rows, expected {row.rows}")
    if row.report.get("upload_options") is not None:
        files.recording(row.id, row.report["upload_sha256"])


def _robots(database: Database, files: Files) -> Iterator[_Finding]:
    with database.session() as session:
        rows = list(session.scalars(select(RobotRow).options(undefer(RobotRow.urdf))))
    for row in rows:
        same = hashlib.sha256(row.urdf.encode()).hexdigest() == row.sha256
        yield row.id, _deletion_check(RobotRow, row.seq), None if same else "the sha256 of its URDF has changed"


def _versions(database: Database, files: Files) -> Iterator[_Finding]:
    with database.session() as session:
        rows = list(session.scalars(select(VersionRow)))
    for row in rows:
        reason = _reason(_read_version, files, row)
        yield f"{row.version} of model {row.model!r}", _deletion_check(VersionRow, (row.model, row.version)), reason


def _read_version(files: Files, row: VersionRow) -> None:
    probe(files.load_version(row.folder, row.checksums))
    if files.read_version(row.folder, persistence.read_manifest) != registry.manifest_on_disk(row):
        raise ValueError("manifest.json differs from the manifest in the database")


def _snapshots(database: Database, files: Files) -> Iterator[_Finding]:
    with database.session() as session:
        rows = list(
            session.scalars(select(SnapshotRow).order_by(SnapshotRow.model, SnapshotRow.version, SnapshotRow.number))
        )
        versions = {(row.model, row.version): row for row in session.scalars(select(VersionRow))}
    for key, of_version in groupby(rows, lambda row: (row.model, row.version)):
        base = _base(files, versions.get(key))  # one model in memory at a time
        known = None if base is None else state_as_trained(database, *key, base)
        for row in of_version:
            reason = _reason(_read_snapshot, files, row)
            if reason is None and known is not None:
                try:
                    known = _compared(database, files, row, known)
                except (ValueError, OSError) as error:
                    reason = str(error)
            name = f"{row.id} of version {row.version} of model {row.model!r}"
            yield name, _deletion_check(SnapshotRow, row.seq), reason


def _base(files: Files, row: VersionRow | None) -> lipcore.TorqueModel | None:
    """Return the version as trained, or None if it cannot be read: that is reported for the version."""
    try:
        return None if row is None else files.load_version(row.folder, row.checksums)
    except lipcore.ModelFormatError:
        return None


def _read_snapshot(files: Files, row: SnapshotRow) -> None:
    files.read_snapshot(row.id, row.sha256)


def _compared(database: Database, files: Files, row: SnapshotRow, known: RestoredState) -> RestoredState:
    """Return the state of a snapshot; raise ValueError if it differs from the fold of the log since `known`."""
    online = state.load(known.online.base, files.read_snapshot(row.id, row.sha256))
    expected = recompute(database, known, row.number)
    if expected is not None:
        check_same(online, expected.online)
    return replace(known, online=online, number=row.number)


def _models(database: Database, files: Files) -> Iterator[_Finding]:
    """Recompute the state of each serving version from its newest snapshot and the log, and test its predictions."""
    with database.session() as session:
        serving = {row.model: row.version for row in session.scalars(select(ServingRow))}
        versions = {(row.model, row.version): row for row in session.scalars(select(VersionRow))}
    for model, version in serving.items():
        gone = _deletion_check(VersionRow, (model, version))
        base = _base(files, versions.get((model, version)))
        yield repr(model), gone, None if base is None else _reason(_read_model, database, files, model, version, base)


def _read_model(database: Database, files: Files, model: str, version: int, base: lipcore.TorqueModel) -> None:
    with database.moment() as session:
        read_options(session, model)
        gap = find_gap(session, model)
    if gap is not None:
        raise ValueError(f"its log lacks events between {gap[0]} and {gap[1]}")
    known = restore(database, files, model, version, base)
    floor = error_floor_of(database, model, version, known.number, base.n_joints)
    probe(known.online.model(floor))


def _observations(database: Database, files: Files) -> Iterator[_Finding]:
    last = 0
    while True:
        query = select(EventRow).where(EventRow.seq > last, EventRow.payload.is_not(None)).order_by(EventRow.seq)
        with database.session() as session:
            rows = list(session.scalars(query.limit(200).options(undefer(EventRow.payload))))
        if not rows:
            return
        for row in rows:
            yield f"{row.number} of model {row.model!r}", _deletion_check(EventRow, row.seq), _reason(_read_event, row)
        last = rows[-1].seq


def _read_event(row: EventRow) -> None:
    if row.kind not in get_args(EventKind):
        raise ValueError(f"the event is of the unknown kind {row.kind!r}")
    rows = decode(row.payload or b"")
    # a batch without accelerations is logged with the rows of adjacent batches that it completes
    first, last = (row.report or {}).get("own", (0, len(rows)))
    if last > len(rows) or last - first != row.rows:
        raise ValueError(f"the batch has {min(last, len(rows)) - first} rows, expected {row.rows}")


def _reason(read: Callable[..., None], *arguments: Any) -> str | None:
    """Return why an item cannot be read, or None if it can."""
    try:
        read(*arguments)
    except FilesUnreachableError:  # says nothing about the file itself
        raise
    except (ValueError, OSError, DamagedDataError) as error:
        return str(error)
    return None


def _deletion_check(table: type[Any], key: object) -> Callable[[Session], bool]:
    """Return a function that checks whether a row has been deleted."""
    return lambda session: session.get(table, key) is None


_CHECKS: dict[str, Callable[[Database, Files], Iterator[_Finding]]] = {
    "datasets": _datasets,
    "robots": _robots,
    "versions": _versions,
    "snapshots": _snapshots,
    "observations": _observations,
    "models": _models,
}


app = alone()
ERRORS = (HomeError,)


@app.command()
def verify(as_json: Json = False) -> None:
    """Check everything stored in the home LIPSERVE_HOME and report damage. Works while the service is running."""
    settings = settings_of()
    with explain_home_errors(settings):
        findings = verify_home(settings)
    if as_json:
        print_json(findings.document())
    else:
        for damage in findings.damages:
            err.print(f"[red]damaged:[/red] {escape(str(damage))}", highlight=False, soft_wrap=True)
        counts = ", ".join(counted(count, kind.removesuffix("s"), kind) for kind, count in findings.read.items())
        echo(f"read {counts}: {len(findings.damages) or 'nothing'} damaged")
    if findings.damages:
        raise typer.Exit(1)
