"""Storing and finding data sets."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from lipcore.data.samples import Samples
from lipcore.profiles import Profile
from lipcore.vocabulary import JointType
from service.datasets.mapping.reading import read
from service.datasets.options import UploadOptions
from service.datasets.preview import Preview, preview_file
from service.datasets.report.making import make_report
from service.datasets.schema import Dataset, DatasetPage
from service.datasets.staging import Staged, column, prepare, staging
from service.foundation.errors import ConflictError, not_found
from service.foundation.states import ACTIVE
from service.robots.store import profile_of
from service.storage import sample_file
from service.storage.database import Database, DatasetRow, JobRow, now
from service.storage.files import Files, new_id
from service.storage.sample_file import PartOf
from service.storage.storage import Storage
from service.web.idempotency import Identity, done, mark
from service.web.pagination import Page, newest
from service.web.storage_errors import undecided


def add(
    storage: Storage, upload: Path, kind: str, name: str, options: UploadOptions, named: Identity | None = None
) -> Dataset:
    """Read, check and prepare an upload, then store it: samples first, the row that makes them visible last.

    Columns lie on disk meanwhile, below the uploads. named: the request, which is not done again where it was before.
    Raise InvalidDataError, InvalidRequestError, TooLargeError, StorageFullError or ConflictError.
    """
    from service.datasets.formats.opening import open_table  # noqa: PLC0415 - pyarrow is 35 MiB, for uploads only

    with storage.database.session() as session:
        if (before := done(session, DatasetRow, named)) is not None:
            return _show(before)
    settings, disk = storage.settings, storage.disk
    profile = None if options.robot is None else profile_of(storage.database, options.robot)
    with staging(storage.files.uploads) as folder:
        with open_table(upload, kind, options.read, settings) as table:
            recording = read(table, folder, options, profile, settings, disk)
        prepared = prepare(recording.staged, folder, options.recipe, settings.min_samples, disk)
        gravity = recording.torque_convention == "gravity_included"
        report = make_report(recording.staged, prepared, profile, recording.noted, settings, options.recipe, gravity)
        report["source"] = recording.facts
        report["joint_types"] = None if profile is None else _joint_types(profile, recording.staged.joint_names)
        staged = prepared.staged
        disk.take(sample_file.size(staged.rows, staged.n_joints))
        dataset = new_id("ds")
        digest = storage.files.write_samples(dataset, staged.rows, staged.n_joints, partial(_array, staged))
    row = DatasetRow(
        id=dataset,
        name=name,
        created_at=now(),
        sha256=digest,
        torque_convention=recording.torque_convention,
        joint_names=list(staged.joint_names),
        rows=staged.rows,
        report=report,
    )
    mark(row, named)
    try:
        with storage.database.transaction() as session:
            if (before := done(session, DatasetRow, named)) is None:
                session.add(row)
    except (SQLAlchemyError, ConflictError) as error:
        if not undecided(error):
            storage.files.delete_samples(dataset)
        raise
    if before is not None:  # the same request was faster on another connection
        storage.files.delete_samples(dataset)
        return _show(before)
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


def samples(files: Files, row: DatasetRow, most: int | None = None, part: PartOf | None = None) -> Samples:
    """Read the samples of a data set, or part of them, evenly thinned to `most`; raise DamagedDataError."""
    return files.read_samples(row.id, row.joint_names, row.sha256, most, part)


def preview(storage: Storage, dataset: str, quantities: Sequence[str], points: int) -> Preview:
    """Thin some quantities of a data set for a plot; raise NotFoundError or DamagedDataError."""
    row = find(storage.database, dataset)
    return preview_file(storage.files.samples_file(row.id, row.sha256), row.joint_names, quantities, points)


def page(database: Database, part: Page) -> DatasetPage:
    """List data sets, newest first."""
    with database.session() as session:
        rows, following = newest(session, DatasetRow, part)
    return DatasetPage(items=[_show(row) for row in rows], next_cursor=following)


def delete(storage: Storage, dataset: str) -> None:
    """Delete a data set; raise ConflictError while a job waits for it or reads it."""
    with storage.database.transaction() as session:
        row = session.scalar(select(DatasetRow).where(DatasetRow.id == dataset))
        if row is None:
            raise not_found("dataset", dataset)
        for job in session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))):
            if dataset in job.request["datasets"]:
                raise ConflictError(f"data set {dataset!r} is in use by job {job.id!r}: cancel it or wait for its end")
        session.delete(row)
    storage.files.delete_samples(dataset)


def _joint_types(profile: Profile, joint_names: Sequence[str]) -> list[JointType] | None:
    """Types of the joints by the robot; None where it does not have them all."""
    places = profile.match(joint_names)
    types = [profile.joint_types[place] for place in places if place is not None]
    return types if len(types) == len(joint_names) else None


def _array(staged: Staged, name: str) -> NDArray[np.float64] | NDArray[np.int64]:
    """One array of the samples, filled column by column."""
    if name in ("t", "episode"):
        return staged.read(name)
    values = np.empty((staged.rows, staged.n_joints))
    for joint in range(staged.n_joints):
        values[:, joint] = staged.read(column(name, joint))
    return values


def _show(row: DatasetRow) -> Dataset:
    return Dataset.model_validate(row, from_attributes=True)
