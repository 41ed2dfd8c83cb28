"""Storing and finding data sets."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from lipcore.model import TorqueConvention
from lipcore.samples import Samples
from service.context import Service
from service.database import Database, DatasetRow, JobRow, now
from service.datasets.checks import check, check_names
from service.datasets.columns import Columns
from service.datasets.csv import read_csv
from service.datasets.npz import read_npz
from service.datasets.preparation import prepare
from service.datasets.schema import Dataset, DatasetPage
from service.errors import ConflictError, not_found
from service.files import ARRAYS, Files, new_id
from service.pages import Page, newest
from service.training.states import ACTIVE

READERS = {"csv": read_csv, "npz": read_npz}


def add(
    service: Service,
    upload: Path,
    kind: str,
    name: str,
    joint_names: tuple[str, ...] | None,
    torque_convention: TorqueConvention,
    cutoff: float,
) -> Dataset:
    """Read, check and prepare an upload, then store it: samples first, the row that makes them visible last."""
    columns: Columns = READERS[kind](upload, service.settings)
    check(columns, service.settings)
    n = columns.q.shape[1]
    names = joint_names or columns.joint_names or tuple(f"joint{i}" for i in range(1, n + 1))
    check_names(names, n)
    prepared = prepare(columns, names, cutoff, service.settings.min_samples)
    service.disk.take(sum(getattr(prepared.samples, each).nbytes for each in ARRAYS))
    dataset = new_id("ds")
    digest = service.files.write_samples(dataset, prepared.samples)
    row = DatasetRow(
        id=dataset,
        name=name,
        created_at=now(),
        sha256=digest,
        torque_convention=torque_convention,
        joint_names=list(names),
        rows=len(prepared.samples),
        report=prepared.report,
    )
    try:
        with service.database.transaction() as session:
            session.add(row)
    except SQLAlchemyError:
        service.files.delete_samples(dataset)
        raise
    return _show(row)


def show(database: Database, dataset: str) -> Dataset:
    """Return one data set; raise NotFoundError."""
    return _show(find(database, dataset))


def find(database: Database, dataset: str) -> DatasetRow:
    """Return the row of a data set; raise NotFoundError."""
    with database.session() as session:
        row = session.scalar(select(DatasetRow).where(DatasetRow.id == dataset))
    if row is None:
        raise not_found("dataset", dataset)
    return row


def samples(files: Files, row: DatasetRow) -> Samples:
    """Read the samples of a data set; raise DamagedDataError."""
    return files.read_samples(row.id, row.joint_names, row.sha256)


def page(database: Database, part: Page) -> DatasetPage:
    """List data sets, newest first."""
    with database.session() as session:
        rows, following = newest(session, DatasetRow, part)
    return DatasetPage(items=[_show(row) for row in rows], next_cursor=following)


def delete(service: Service, dataset: str) -> None:
    """Delete a data set; raise ConflictError while a job waits for it or reads it."""
    with service.database.transaction() as session:
        row = session.scalar(select(DatasetRow).where(DatasetRow.id == dataset))
        if row is None:
            raise not_found("dataset", dataset)
        for job in session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))):
            if dataset in job.request["datasets"]:
                raise ConflictError(f"data set {dataset!r} is in use by job {job.id!r}: cancel it or wait for its end")
        session.delete(row)
    service.files.delete_samples(dataset)


def _show(row: DatasetRow) -> Dataset:
    return Dataset.model_validate(
        {
            "id": row.id,
            "name": row.name,
            "created_at": row.created_at,
            "sha256": row.sha256,
            "joint_names": row.joint_names,
            "torque_convention": row.torque_convention,
            "report": row.report,
        }
    )
