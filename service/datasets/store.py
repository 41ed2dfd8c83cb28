"""Storage of data sets: add, find, list, preview and delete them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from sqlalchemy import String, cast, select
from sqlalchemy import delete as delete_rows
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.profiles import Profile
from lipcore.vocabulary import JointType
from service.contract.datasets import MAX_PREVIEW_STARTS, Dataset, DatasetPage, DatasetReport, Preview, PreviewColumn
from service.contract.states import ACTIVE
from service.contract.uploads import RereadQuery, UploadQuery
from service.datasets.mapping.checks import MIN_SAMPLES
from service.datasets.mapping.reading import Recording
from service.datasets.options import upload_options
from service.datasets.report.constants import estimate_constants
from service.datasets.report.making import make_report
from service.datasets.staging import Staged, column, prepare, staging
from service.foundation.errors import ConflictError, invalid_request, not_found
from service.models import verdicts
from service.robots.store import profile_of
from service.runtime import cage
from service.storage import sample_file
from service.storage.database import Database, DatasetRow, JobRow, now
from service.storage.errors import is_undecided
from service.storage.files import Files, new_id
from service.storage.rows import Page, RequestIdentity, find_done_row, mark_row, read_page
from service.storage.sample_file import PartOf
from service.storage.storage import Storage

READER = "service.datasets.caged:read_upload"
MAX_LISTED_IDS = 5
"""Max ids that an error lists if several data sets have the same name."""


def add(
    storage: Storage, upload: Path, kind: str, name: str, query: UploadQuery, named: RequestIdentity | None = None
) -> Dataset:
    """Read, check, prepare and store an upload, and delete its file.

    Samples and a copy of the file are stored first. The database row, which makes them visible, comes last. Columns are
    staged on disk below the uploads. named: the request; if it was done before, its data set is returned.

    Raise InvalidDataError, InvalidRequestError, TooLargeError, StorageFullError or ConflictError.
    """
    with storage.database.session() as session:
        if (before := find_done_row(session, DatasetRow, named)) is not None:
            return _show(before)
    settings, disk, options = storage.settings, storage.disk, upload_options(query)
    profile = None if options.robot is None else profile_of(storage.database, options.robot)
    with staging(storage.files.uploads) as folder:
        upload = upload.rename(folder / upload.name)
        robot = None if profile is None else replace(profile, urdf=None)
        arguments = upload, kind, options, robot, disk.usage(), folder, settings
        recording = cage.run(READER, Recording, *arguments, settings=settings, folder=folder)
        raw = Staged.of_others(folder, recording.joint_names, recording.lengths, disk)
        prepared = prepare(raw, folder, options.recipe, MIN_SAMPLES, disk)
        if recording.facts["effort"] == "current" and recording.facts["torque_constants"] is None:
            assert profile is not None  # the reader has checked it
            constants = estimate_constants(prepared, profile)
            recording.facts["torque_constants"] = constants.values.tolist()
            recording.noted.append(constants.text)
            for staged in (raw, prepared.staged):
                staged.scale("tau", constants.values)
        gravity = recording.torque_convention == "gravity_included"
        report = make_report(raw, prepared, profile, recording.noted, options.recipe, gravity, recording.facts)
        report["upload_sha256"], report["upload_kind"] = sample_file.sha256(upload), kind
        report["upload_options"] = query.model_dump(exclude_unset=True, exclude={"name"}, exclude_none=True)
        report["joint_types"] = None if profile is None else _joint_types(profile, raw.joint_names)
        staged = prepared.staged
        disk.reserve(sample_file.count_bytes(staged.rows, staged.n_joints) + upload.stat().st_size)
        dataset = new_id("ds")
        storage.files.keep_recording(dataset, upload)
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
    mark_row(row, named)
    try:
        with storage.database.transaction() as session:
            if (before := find_done_row(session, DatasetRow, named)) is None:
                session.add(row)
    except (SQLAlchemyError, ConflictError) as error:
        if not is_undecided(error):
            storage.files.delete_dataset(dataset)
        raise
    if before is not None:  # the same request finished first on another connection
        storage.files.delete_dataset(dataset)
        return _show(before)
    return _show(row)


def read_again(storage: Storage, dataset: str, query: RereadQuery, named: RequestIdentity | None = None) -> Dataset:
    """Read the file of a data set with further options, as a new data set; delete the old one if no job used it.

    Raise as `add` does, NotFoundError, DamagedDataError, or ConflictError if an earlier release stored the data set.
    """
    with storage.database.session() as session:
        if (done := find_done_row(session, DatasetRow, named)) is not None:
            return _show(done)
        row = existing(session, dataset)
    before = row.report.get("upload_options")
    if before is None:
        raise ConflictError(f"The file of data set {dataset!r} was not kept by an earlier release. Upload it again.")
    upload = storage.files.upload()
    try:
        file = storage.files.recording(row.id, row.report["upload_sha256"])
        storage.disk.reserve(file.stat().st_size)
        shutil.copyfile(file, upload)
        given = query.model_dump(exclude_unset=True, exclude_none=True, exclude={"fresh"})
        merged = UploadQuery.model_validate(given if query.fresh else before | given)
        made = add(storage, upload, row.report["upload_kind"], query.name or row.name, merged, named)
    finally:
        upload.unlink(missing_ok=True)
    with storage.database.transaction() as session:
        used = cast(JobRow.request["datasets"], String).contains(row.id)
        replaced = session.scalar(select(JobRow.id).where(used).limit(1)) is None
        if replaced:
            session.execute(delete_rows(DatasetRow).where(DatasetRow.id == row.id))
    if replaced:
        storage.files.delete_dataset(row.id)
    return made


def show(database: Database, dataset: str) -> Dataset:
    """Return one data set; raise NotFoundError."""
    return _show(find(database, dataset))


def find(database: Database, dataset: str) -> DatasetRow:
    """Return the row of a data set by its id or its name.

    Of several readings of one file it is the newest. Raise NotFoundError, or InvalidRequestError if data sets of
    several files have the name.
    """
    with database.session() as session:
        return existing(session, dataset)


def existing(session: Session, dataset: str, only: bool = False) -> DatasetRow:
    """Return the row as `find` does, in a session. only: whether to reject a name of several readings, too."""
    row = session.scalar(select(DatasetRow).where(DatasetRow.id == dataset))
    if row is not None:
        return row
    called = (
        select(DatasetRow).where(DatasetRow.name == dataset).order_by(DatasetRow.seq.desc()).limit(MAX_LISTED_IDS + 1)
    )
    rows = list(session.scalars(called))
    if not rows:
        raise not_found("dataset", dataset)
    if len({row.id if only else row.report.get("upload_sha256") or row.id for row in rows}) > 1:
        ids = ", ".join(each.id for each in rows[:MAX_LISTED_IDS]) + (" …" if len(rows) > MAX_LISTED_IDS else "")
        message = f"Several data sets are named {dataset!r}. Use one of their ids: {ids}."
        raise invalid_request("dataset", dataset, f"one of the ids {ids}", message)
    return rows[0]


def samples(
    files: Files,
    row: DatasetRow,
    most: int | None = None,
    part: PartOf | None = None,
    joint_types: Sequence[str] | None = None,
) -> Samples:
    """Read samples of a data set, evenly thinned to at most `most`; raise DamagedDataError.

    joint_types: to include deflections; None for none.
    """
    return files.read_samples(row.id, row.joint_names, row.sha256, most, part, joint_types)


def preview(storage: Storage, dataset: str, quantities: Sequence[str], points: int) -> Preview:
    """Thin some quantities of a data set for a plot; raise NotFoundError or DamagedDataError."""
    row = find(storage.database, dataset)
    return preview_file(storage.files.samples_file(row.id, row.sha256), row.joint_names, quantities, points)


def page(database: Database, part: Page, upload_sha256: str | None = None) -> DatasetPage:
    """List data sets, newest first. upload_sha256: list only uploads of a file with this hash."""
    of_file = () if upload_sha256 is None else (DatasetRow.report["upload_sha256"].as_string() == upload_sha256,)
    with database.session() as session:
        rows, following = read_page(session, DatasetRow, part, *of_file)
    return DatasetPage(items=[_show(row) for row in rows], next_cursor=following)


def delete(storage: Storage, dataset: str) -> None:
    """Delete a data set; raise ConflictError if a queued or running job needs it."""
    with storage.database.transaction() as session:
        row = existing(session, dataset, only=True)
        for job in session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))):
            if row.id in job.request["datasets"]:
                raise ConflictError(
                    f"data set {dataset!r} is in use by {job.id}: cancel this job or wait until it has finished"
                )
        session.delete(row)
    storage.files.delete_dataset(row.id)


def _joint_types(profile: Profile, joint_names: Sequence[str]) -> list[JointType] | None:
    """Return the joint types of the robot, None if it lacks a joint."""
    places = profile.match(joint_names)
    types = [profile.joint_types[place] for place in places if place is not None]
    return types if len(types) == len(joint_names) else None


def _array(staged: Staged, name: str) -> NDArray[np.float64] | NDArray[np.int64]:
    """Return one array of the samples, filled column by column."""
    if name in ("t", "episode"):
        return staged.read(name)
    values = np.empty((staged.rows, staged.n_joints))
    for joint in range(staged.n_joints):
        values[:, joint] = staged.read(column(name, joint))
    return values


def _show(row: DatasetRow) -> Dataset:
    report = DatasetReport.model_validate(row.report)
    fields = {name: getattr(row, name) for name in Dataset.model_fields if name not in ("learnability", "report")}
    return Dataset(**fields, learnability=verdicts.of_recording(row), report=report)


MAX_PREVIEW_POINTS = 2000
"""Max points of a column in a preview."""

ReadRows = Callable[[str, int, int], Array]
"""(quantity, first row, row after the last) → these rows of all joints, (rows, n)."""


def make_preview(
    t: Array,
    episode: NDArray[np.int64] | Array,
    joint_names: Sequence[str],
    quantities: Sequence[str],
    read: ReadRows,
    points: int = MAX_PREVIEW_POINTS,
) -> Preview:
    """Thin the quantities of all joints to at most `points` points per column; t, episode: (N,)."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(episode)) + 1])
    starts = starts[spaced_rows(len(starts), MAX_PREVIEW_STARTS)]
    columns = []
    for quantity in quantities:
        for name, (rows, values) in zip(joint_names, extremes(len(t), quantity, read, points), strict=True):
            columns.append(
                PreviewColumn(
                    quantity=quantity,
                    joint=name,
                    unit={"q": "rad or m", "dq": "rad/s or m/s", "ddq": "rad/s² or m/s²", "tau": "N·m or N"}[quantity],
                    rows=rows.tolist(),
                    t=t[rows].tolist(),
                    values=values.tolist(),
                )
            )
    return Preview(samples=len(t), starts=starts.tolist(), columns=columns)


def extremes(count: int, quantity: str, read: ReadRows, points: int) -> list[tuple[NDArray[np.int64], Array]]:
    """Return for each joint at most `points` ascending rows and their values: all, or the extremes of stretches."""
    if points < 2:
        raise ValueError(f"points is {points}, expected at least 2")
    if count <= points:
        every_row = read(quantity, 0, count)
        return [(np.arange(count, dtype=np.int64), column) for column in every_row.T]
    rows, values = [], []
    for first, last in pairwise(np.linspace(0, count, points // 2 + 1).astype(np.int64).tolist()):
        stretch = read(quantity, first, last)
        both = np.sort([stretch.argmin(axis=0), stretch.argmax(axis=0)], axis=0)
        rows.append(first + both)
        values.append(np.take_along_axis(stretch, both, axis=0))
    at, what = np.concatenate(rows).T, np.concatenate(values).T
    # a constant stretch gives one point
    new = [np.concatenate([[True], np.diff(each) > 0]) for each in at]
    return [(a[keep].astype(np.int64), b[keep]) for a, b, keep in zip(at, what, new, strict=True)]


def preview_file(path: Path, joint_names: Sequence[str], quantities: Sequence[str], points: int) -> Preview:
    """Preview stored samples, see sample_file.py. Only the times and one stretch of rows are in memory."""
    with safe_open(path, framework="numpy") as file:
        slices = {quantity: file.get_slice(quantity) for quantity in quantities}
        return make_preview(
            file.get_tensor("t"),
            file.get_tensor("episode"),
            joint_names,
            quantities,
            lambda quantity, first, last: np.asarray(slices[quantity][first:last]),
            points,
        )
