"""Named models and their versions: publishing, finding, listing."""

from __future__ import annotations

import logging
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

import lipcore
from lipcore.persistence import read_manifest
from service.database import Database, ModelRow, VersionRow, now
from service.errors import not_found
from service.files import Files, new_id
from service.models.schema import Model, ModelPage, Version, VersionSummary
from service.pages import Page, newest
from service.settings import shipped_models

logger = logging.getLogger(__name__)

SHIPPED = "panda-sim"


def publish(session: Session, model: str, folder: str, manifest: dict[str, Any], job: str | None) -> int:
    """Add a version whose files are complete; it is visible once the session commits. Return its number."""
    if session.scalar(select(ModelRow).where(ModelRow.name == model)) is None:
        session.add(ModelRow(name=model, created_at=now()))
        session.flush()
    latest = session.scalar(select(func.max(VersionRow.version)).where(VersionRow.model == model)) or 0
    session.add(
        VersionRow(model=model, version=latest + 1, folder=folder, created_at=now(), job=job, manifest=manifest)
    )
    return int(latest + 1)


def install_shipped(database: Database, files: Files) -> None:
    """Register the model that comes with LIPServe; where an upgrade brings another one, as a new version.

    Not if the user has trained a version of that name since, which goes on answering.
    """
    source = shipped_models() / SHIPPED
    query = select(VersionRow).where(VersionRow.model == SHIPPED).order_by(VersionRow.version.desc()).limit(1)
    with database.session() as session:
        newest = session.scalars(query).first()
    if newest is not None and (newest.job is not None or _same_tensors(newest.manifest, read_manifest(source))):
        return
    folder = new_id("mv")
    manifest = lipcore.copy_model(source, files.versions / folder)
    with database.transaction() as session:
        version = publish(session, SHIPPED, folder, manifest, None)
    logger.info("registered the shipped model %s as version %d", SHIPPED, version)


def _same_tensors(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return bool(one["tensors"]["sha256"] == other["tensors"]["sha256"])


def find(database: Database, model: str, version: int | None) -> VersionRow:
    """Return a version, the latest where None; raise NotFoundError."""
    query = select(VersionRow).where(VersionRow.model == model)
    query = query.order_by(VersionRow.version.desc()) if version is None else query.where(VersionRow.version == version)
    with database.session() as session:
        row = session.scalars(query.limit(1)).first()
        if row is None:
            known = session.scalar(select(ModelRow).where(ModelRow.name == model))
            raise not_found("model", model) if known is None else not_found("version", version)
    return row


def recent(database: Database, count: int) -> list[VersionRow]:
    """Return the latest versions of the models that changed last, at most `count`."""
    newest = select(VersionRow.model, func.max(VersionRow.version).label("version")).group_by(VersionRow.model)
    latest = newest.subquery()
    query = (
        select(VersionRow)
        .join(latest, (VersionRow.model == latest.c.model) & (VersionRow.version == latest.c.version))
        .order_by(VersionRow.created_at.desc())
        .limit(count)
    )
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
    return Model(
        name=row.name,
        created_at=row.created_at,
        latest_version=versions[-1].version,
        versions=[
            VersionSummary(version=v.version, created_at=v.created_at, estimator=v.manifest["estimator"])
            for v in versions
        ],
    )
