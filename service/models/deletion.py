"""Delete versions and models: first their rows, then their files. Nothing answers from either afterwards."""

from __future__ import annotations

import logging
from collections.abc import Collection
from contextlib import suppress

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.contract.states import ACTIVE
from service.foundation.errors import ConflictError, NotFoundError, not_found
from service.models import aliases, registry
from service.models.loaded import LoadedModels
from service.storage import audit
from service.storage.database import (
    AlarmRow,
    AliasMoveRow,
    AliasRow,
    DeletedModelRow,
    EventRow,
    JobRow,
    LearnerRow,
    LearningRow,
    ModelRow,
    ServingRow,
    SnapshotRow,
    StreamRow,
    VersionRow,
    now,
)
from service.storage.files import Files

logger = logging.getLogger(__name__)

MAX_REFRESHED = 10
"""Maximum unused versions kept of those that automatic refreshes of a model made."""
OF_MODEL = (AliasMoveRow, AliasRow, ServingRow, LearnerRow, LearningRow, StreamRow, EventRow, AlarmRow, SnapshotRow)
"""Tables with rows that belong to a model, besides its versions. Jobs and data sets keep their history."""


def delete_version(loaded: LoadedModels, model: str, version: int) -> None:
    """Delete a version permanently; its number is not used again. Blocking: use it in a thread.

    Raise NotFoundError. Raise ConflictError, naming the reason, if an alias points to the version, if it serves or if
    it is the model's only one. Raise it too while a job refreshes the version or starts from it.
    """
    with loaded.moving:
        with loaded.database.transaction() as session:
            row = session.get(VersionRow, (model, version))
            if row is None:
                raise registry.missing(session, model, version)
            _check_unused(session, model, version)
            of_version = (SnapshotRow.model == model, SnapshotRow.version == version)
            snapshots = list(session.scalars(select(SnapshotRow.id).where(*of_version)))
            session.execute(delete(SnapshotRow).where(*of_version))
            session.execute(delete(LearnerRow).where(LearnerRow.model == model, LearnerRow.version == version))
            session.delete(row)
            audit.note(session, model, "version deleted", version, before=version)
        loaded.forget(model, [version])
    _remove_files(loaded.files, [row.folder], snapshots)
    loaded.wake(model)
    logger.info("deleted version %d of model %s", version, model)


def delete_refreshed(loaded: LoadedModels, model: str) -> None:
    """Delete the versions made by automatic refreshes that nothing needs. Blocking: use it in a thread.

    Kept are the newest MAX_REFRESHED, every version in use and the one that a rollback of `serving` returns to.
    """
    with loaded.database.session() as session:
        trigger = JobRow.request["refresh"]["trigger"].as_string()
        by_itself = (VersionRow.model == model, trigger != "asked")  # NULL for jobs other than refreshes
        made = select(VersionRow.version).join(JobRow, JobRow.id == VersionRow.job).where(*by_itself)
        older = list(session.scalars(made.order_by(VersionRow.version.desc()).offset(MAX_REFRESHED)))
        move = aliases.standing(session, model, registry.SERVING)
    for version in older:
        if move is None or version != move.before:
            with suppress(ConflictError, NotFoundError):
                delete_version(loaded, model, version)


def delete_model(loaded: LoadedModels, model: str) -> None:
    """Delete a model with its versions, aliases, log, streams, snapshots and alarms. Blocking: use it in a thread.

    A later model of the same name continues the version numbers. Raise NotFoundError, or ConflictError while a job of
    the model, or a job that starts from one of its versions, waits or runs.
    """
    with loaded.moving:
        with loaded.database.transaction() as session:
            row = session.scalar(select(ModelRow).where(ModelRow.name == model))
            if row is None:
                raise not_found("model", model)
            for job in _active_jobs(session):
                if job.model == model:
                    raise ConflictError(f"{job.id} of model {model!r} is {job.state}: cancel it or wait until it ends")
                if (job.request.get("base") or "").partition(":")[0] == model:
                    raise ConflictError(f"{job.id} starts from model {model!r}: cancel it or wait until it ends")
            versions = list(session.scalars(select(VersionRow).where(VersionRow.model == model)))
            snapshots = list(session.scalars(select(SnapshotRow.id).where(SnapshotRow.model == model)))
            _note_deletion(session, row, [each.version for each in versions])
            audit.note(session, model, "model deleted", before=[each.version for each in versions])
            for table in OF_MODEL:
                session.execute(delete(table).where(table.model == model))
            session.execute(delete(VersionRow).where(VersionRow.model == model))
            session.execute(delete(ModelRow).where(ModelRow.name == model))
        loaded.forget(model, [each.version for each in versions], entirely=True)
    _remove_files(loaded.files, [each.folder for each in versions], snapshots)
    loaded.wake(model)
    logger.info("deleted model %s with %d versions", model, len(versions))


def _check_unused(session: Session, model: str, version: int) -> None:
    """Raise ConflictError, naming the reason, if a version is in use."""
    name = f"version {version} of model {model!r}"
    aliases = select(AliasRow.alias).where(AliasRow.model == model, AliasRow.version == version)
    if pointing := list(session.scalars(aliases.order_by(AliasRow.alias))):
        raise ConflictError(f"{name} has the alias {', '.join(map(repr, pointing))}: move or remove it first")
    if registry.serving_version(session, model) == version:
        raise ConflictError(f"{name} is the serving version: let another version serve first, or delete the model")
    if session.scalar(select(func.count()).select_from(VersionRow).where(VersionRow.model == model)) == 1:
        raise ConflictError(f"{name} is its only version: delete the model instead")
    for job in _active_jobs(session):
        if job.model == model and (job.request.get("refresh") or {}).get("version") == version:
            raise ConflictError(f"{job.id} refreshes {name}: cancel it or wait until it ends")
        if job.request.get("base") == f"{model}:{version}":
            raise ConflictError(f"{job.id} starts from {name}: cancel it or wait until it ends")


def _active_jobs(session: Session) -> list[JobRow]:
    return list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE))))


def _note_deletion(session: Session, row: ModelRow, versions: Collection[int]) -> None:
    """Record the highest version number used."""
    deleted = session.get(DeletedModelRow, row.name)
    if deleted is None:
        deleted = DeletedModelRow(name=row.name)
        session.add(deleted)
    deleted.last_version, deleted.deleted_at = max(row.last_version, *versions, 0), now()


def _remove_files(files: Files, folders: Collection[str], snapshots: Collection[str]) -> None:
    """Remove files that no row refers to any more; files that cannot be removed now are removed at the next start."""
    for delete_file, names in ((files.delete_version, folders), (files.delete_snapshot, snapshots)):
        for name in names:
            try:
                delete_file(name)
            except OSError as error:
                logger.warning("could not delete a file of a deleted version; the next start will: %s", error)
