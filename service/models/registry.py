"""Named models and their versions: publishing, finding, listing, and which of them answers."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError
from sqlalchemy import bindparam, func, select, tuple_, update
from sqlalchemy.orm import Session

import lipcore
from lipcore.estimators.base import RobotKind
from lipcore.files.persistence import checksums, read_manifest
from service.contract.models import HeldOutQuality, Model, ModelPage, Promotion, Version, VersionSummary
from service.foundation.errors import ConflictError, NoServingVersionError, NotFoundError, not_found
from service.foundation.settings import shipped_models
from service.storage import audit
from service.storage.database import (
    AliasMoveRow,
    AliasRow,
    Database,
    DeletedModelRow,
    EventRow,
    LearnerRow,
    ModelRow,
    ServingRow,
    VersionRow,
    fetch,
    now,
)
from service.storage.files import Files, new_id
from service.storage.rows import Page, newest

logger = logging.getLogger(__name__)

SHIPPED = "panda-sim"
SERVING = "serving"
"""The alias that every model has: the version that answers where none is named."""
MAX_ALIASES = 100
"""Aliases of one model, `serving` aside."""


_VERSION = select(VersionRow.version).where(
    VersionRow.model == bindparam("model"), VersionRow.version == bindparam("version")
)


class Serving(NamedTuple):
    """Which version of a model answers where none is named. change: higher for what was decided later."""

    version: int
    change: int


PROMOTION = "promotion"
"""What a version's row has beside its manifest: the file was written before it was known."""


def manifest_on_disk(row: VersionRow) -> dict[str, Any]:
    """The manifest of a version as its file has it."""
    return {name: value for name, value in row.manifest.items() if name != PROMOTION}


def publish(
    session: Session,
    model: str,
    folder: str,
    manifest: dict[str, Any],
    job: str | None,
    candidate: bool = False,
    start: int | None = None,
    promotion: Promotion | None = None,
) -> int:
    """Add a version whose files are complete; it is visible once the session commits. Return its number.

    It answers from then on, unless it is a candidate. start: number of the last event of the model that it contains by
    training, the newest where None; promotion: why it answers, or does not.
    """
    row = _row(session, model)
    row.last_version = version = row.last_version + 1
    audit.note(session, model, "version added", version, after=_origin(manifest, job))
    session.add(
        VersionRow(
            model=model,
            version=version,
            folder=folder,
            created_at=now(),
            job=job,
            manifest=manifest if promotion is None else {**manifest, PROMOTION: promotion.model_dump()},
            checksums=checksums(manifest),
        )
    )
    if start is None:
        start = session.scalar(select(func.max(EventRow.number)).where(EventRow.model == model)) or 0
    session.add(LearnerRow(model=model, version=version, start=start, role="dismissed"))
    if not candidate:
        serve(session, model, version)
    return version


def _origin(manifest: dict[str, Any], job: str | None) -> dict[str, Any]:
    """What the audit log says of a new version: of an imported one also where it comes from."""
    imported = manifest["lineage"].get("imported", []) if job is None else []
    source = {name: imported[-1].get(name) for name in ("model", "version")} if imported else {}
    return {"estimator": manifest["estimator"], "job": job, **({"imported": source} if source else {})}


def _row(session: Session, model: str) -> ModelRow:
    """The row of a model, a new one where there is none: no number of one that was deleted is given again."""
    row = session.scalar(select(ModelRow).where(ModelRow.name == model))
    if row is None:
        deleted = session.get(DeletedModelRow, model)
        row = ModelRow(name=model, created_at=now(), last_version=0 if deleted is None else deleted.last_version)
        session.add(row)
        session.flush()
    return row


def check_robot(session: Session, model: str, kind: RobotKind) -> None:
    """Raise ConflictError where a model's first version is of another robot than one that is to answer for it."""
    query = select(VersionRow).where(VersionRow.model == model).order_by(VersionRow.version).limit(1)
    first = session.scalar(query)
    found = None if first is None else RobotKind.of_manifest(first.manifest).difference(kind)
    if first is not None and found is not None:
        field, own, others = found
        raise ConflictError(
            f"model {model!r} is of another robot: the {field} of its version {first.version}: {own}; of this one: "
            f"{others}. Choose another name"
        )


def answering(session: Session, model: str) -> int | None:
    """The version that answers where none is named, None where there is none."""
    chosen = session.get(ServingRow, model)
    return None if chosen is None else chosen.version


def has_model(session: Session, model: str) -> bool:
    """Whether there is a model of this name."""
    return session.scalar(select(ModelRow.name).where(ModelRow.name == model)) is not None


def missing(session: Session, model: str, version: int | None) -> NotFoundError | NoServingVersionError:
    """The error for a version that there is not: of its model, where that is none either. version: None for the one
    that serves."""
    if not has_model(session, model):
        return not_found("model", model)
    if version is not None:
        return not_found("version", version)
    newest = session.scalar(select(func.max(VersionRow.version)).where(VersionRow.model == model))
    return NoServingVersionError(
        f"no version of model {model!r} serves, all wait as candidates: `lipserve models show {model}` says why, and "
        f"`lipserve models promote {model} {newest}` lets the newest answer"
    )


def exists(session: Session, model: str, version: int) -> bool:
    """Whether there is such a version."""
    return fetch(session, _VERSION, model=model, version=version).scalar() is not None


def serve(session: Session, model: str, version: int, takes_back: int | None = None) -> int:
    """Let a version answer where none is named, once the session commits, and learn; return the number of the change.

    The version before neither answers nor learns any more. takes_back: see `note`. Raise NotFoundError where
    there is no such version.
    """
    session.flush()
    if not exists(session, model, version):
        raise not_found("version", version)
    serving = session.get(ServingRow, model)
    if serving is None:
        serving = ServingRow(model=model, version=version, change=1)
        session.add(serving)
        note(session, model, SERVING, None, version)
    elif serving.version != version:
        note(session, model, SERVING, serving.version, version, takes_back)
        serving.version, serving.change = version, serving.change + 1
    served = (LearnerRow.model == model, LearnerRow.role == "serving", LearnerRow.version != version)
    session.execute(update(LearnerRow).where(*served).values(role="dismissed"))
    learner = session.get(LearnerRow, (model, version))
    if learner is None:
        session.add(LearnerRow(model=model, version=version, start=0, role="serving"))
    else:
        learner.role = "serving"
    return serving.change


def note(
    session: Session, model: str, alias: str, before: int | None, version: int | None, takes_back: int | None = None
) -> None:
    """Write a move of an alias down. takes_back: number of the move that this one takes back."""
    audit.note(session, model, "alias moved", version, alias, before, version)
    move = AliasMoveRow(model=model, alias=alias, before=before, version=version, takes_back=takes_back, at=now())
    session.add(move)
    session.flush()


def pointers(database: Database, models: Collection[str] | None = None) -> dict[tuple[str, str], int]:
    """The version of every alias of these models, of all where None, by (model, alias), but for those that serve."""
    query = select(AliasRow.model, AliasRow.alias, AliasRow.version)
    if models is not None:
        query = query.where(AliasRow.model.in_(models))
    with database.session() as session:
        return {(model, alias): version for model, alias, version in session.execute(query)}


def serving(database: Database, models: Collection[str]) -> dict[str, Serving]:
    """Which version of each of these models answers; those that have none are left out."""
    query = select(ServingRow.model, ServingRow.version, ServingRow.change).where(ServingRow.model.in_(models))
    with database.session() as session:
        return {model: Serving(version, change) for model, version, change in session.execute(query)}


def install_shipped(database: Database, files: Files) -> None:
    """Register the model that comes with LIPServe; where an upgrade brings another one, as a new version.

    Not if the user has made a version of that name since, which goes on answering, or has deleted the model or its
    newest version.
    """
    source = shipped_models() / SHIPPED
    with database.session() as session:
        if not _is_missing(session, source):
            return
    folder, version = new_id("mv"), None
    with files.new_version(folder) as target:
        manifest = lipcore.copy_model(source, target)
    with database.transaction() as session:
        if _is_missing(session, source):  # no other service has started at the same time
            version = publish(session, SHIPPED, folder, manifest, None)
    if version is None:
        files.delete_version(folder)
        return
    logger.info("registered the shipped model %s as version %d", SHIPPED, version)


def _is_missing(session: Session, source: Path) -> bool:
    """Whether the shipped model is to be registered."""
    query = select(VersionRow).where(VersionRow.model == SHIPPED).order_by(VersionRow.version.desc())
    known = list(session.scalars(query))
    row = session.scalar(select(ModelRow).where(ModelRow.name == SHIPPED))
    if row is None:
        return session.get(DeletedModelRow, SHIPPED) is None
    if not known:
        return True
    made_by_user = known[0].job is not None or "imported" in known[0].manifest["lineage"]
    if made_by_user or row.last_version > known[0].version:
        return False
    shipped = read_manifest(source)["tensors"]["sha256"]
    return all(each.manifest["tensors"]["sha256"] != shipped for each in known)


def find(database: Database, model: str, version: int | None) -> VersionRow:
    """Return a version, the one that answers where None; raise NotFoundError or NoServingVersionError."""
    with database.session() as session:
        number = answering(session, model) if version is None else version
        row = None if number is None else session.get(VersionRow, (model, number))
        if row is None:
            raise missing(session, model, version)
    return row


def named(database: Database, text: str) -> VersionRow:
    """The version that a text of the pattern `schema.VERSION` names; raise NotFoundError or NoServingVersionError."""
    name, _, alias = text.partition("@")
    model, _, number = name.partition(":")
    if alias in ("", SERVING):
        return find(database, model, int(number) if number else None)
    version = pointers(database, [model]).get((model, alias))
    if version is None:
        raise no_alias(database, model, alias)
    return find(database, model, version)


def no_alias(database: Database, model: str, alias: str) -> NotFoundError:
    """The error for an alias that there is not: of its model, where that is none either."""
    with database.session() as session:
        return not_found("alias", alias) if has_model(session, model) else not_found("model", model)


def recent(database: Database, count: int) -> list[str]:
    """Return the names of the models that changed last, at most `count`."""
    changed = func.max(VersionRow.created_at)
    query = select(VersionRow.model).group_by(VersionRow.model).order_by(changed.desc()).limit(count)
    with database.session() as session:
        return list(session.scalars(query))


def show(database: Database, model: str) -> Model:
    """Return a model with its versions; raise NotFoundError."""
    with database.session() as session:
        row = session.scalar(select(ModelRow).where(ModelRow.name == model))
        if row is None:
            raise not_found("model", model)
        return _show(session, row)


def show_version(database: Database, model: str, version: int) -> Version:
    """Return one version with its lineage; raise NotFoundError."""
    row = find(database, model, version)
    fields = {name: row.manifest[name] for name in Version.model_fields if name in row.manifest}
    return Version(model=row.model, version=row.version, created_at=row.created_at, job=row.job, **fields)


def page(database: Database, part: Page) -> ModelPage:
    """List models, newest first."""
    with database.session() as session:
        rows, following = newest(session, ModelRow, part)
        return ModelPage(items=[_show(session, row) for row in rows], next_cursor=following)


def _show(session: Session, row: ModelRow) -> Model:
    versions = list(
        session.scalars(select(VersionRow).where(VersionRow.model == row.name).order_by(VersionRow.version))
    )
    aliases = session.scalars(select(AliasRow).where(AliasRow.model == row.name).order_by(AliasRow.alias))
    return Model(
        name=row.name,
        created_at=row.created_at,
        latest_version=versions[-1].version,
        serving_version=answering(session, row.name),
        aliases={each.alias: each.version for each in aliases},
        versions=[
            VersionSummary(
                version=v.version,
                created_at=v.created_at,
                estimator=v.manifest["estimator"],
                quality=quality(v.manifest),
                promotion=v.manifest.get(PROMOTION),
            )
            for v in versions
        ],
    )


def quality(manifest: Mapping[str, Any]) -> HeldOutQuality | None:
    """How well a version predicts what its training held out, as its manifest has it; None where that was nothing, or
    is not as this release writes it: an import shows figures and does not read them."""
    try:
        return HeldOutQuality.model_validate(manifest["lineage"]["holdout"])
    except (KeyError, TypeError, ValidationError):
        return None


def rows_of(session: Session, keys: Collection[tuple[str, int]]) -> dict[tuple[str, int], VersionRow]:
    """Versions by model and number; those that are gone are left out."""
    query = select(VersionRow).where(tuple_(VersionRow.model, VersionRow.version).in_(keys))
    return {(row.model, row.version): row for row in session.scalars(query)}


def lost(
    database: Database, files: Files, held: Collection[tuple[str, int]], damaged: Collection[tuple[str, int]]
) -> tuple[int, int]:
    """How many models have a version that serves and cannot be read, and how many have one that serves. held: versions
    in memory, which answer whatever their files are; damaged: those whose files could not be read."""
    with database.session() as session:
        names = list(session.scalars(select(ModelRow.name)))
        rows = session.execute(select(VersionRow.model, VersionRow.version, VersionRow.folder))
        folders = {(model, version): folder for model, version, folder in rows}
    serves = {(model, each.version) for model, each in serving(database, names).items()}
    gone = [key for key in serves - set(held) if key in damaged or not files.has_version(folders.get(key, ""))]
    return len(gone), len(serves)
