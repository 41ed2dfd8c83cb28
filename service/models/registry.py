"""Models and their versions: publish, find and list them, and set which version serves."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any, NamedTuple

from sqlalchemy import bindparam, func, select, tuple_, update
from sqlalchemy.orm import Session

from lipcore.estimators.base import RobotKind
from lipcore.files.persistence import checksums
from lipcore.model.verdict import OPTIONS, VerdictOptions
from lipcore.vocabulary import offered_components
from service.contract.models import Model, ModelPage, Promotion, Version, VersionSummary
from service.contract.verdict import Thresholds
from service.foundation.errors import ConflictError, NoServingVersionError, NotFoundError, not_found
from service.models import verdicts
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
from service.storage.files import Files
from service.storage.rows import Page, read_page

logger = logging.getLogger(__name__)

SERVING = "serving"
"""The alias of every model for its serving version."""
CANDIDATE = "candidate"
"""The alias of the newest version that waits for approval."""
MAX_ALIASES = 100
"""Maximum aliases of one model, besides `serving`."""


_VERSION = select(VersionRow.version).where(
    VersionRow.model == bindparam("model"), VersionRow.version == bindparam("version")
)


class Serving(NamedTuple):
    """The serving version of a model; a later change has a higher `change`."""

    version: int
    change: int


PROMOTION = "promotion"
"""Entry of a version's row that its manifest file lacks, because the file is written first."""


def manifest_on_disk(row: VersionRow) -> dict[str, Any]:
    """Return the manifest of a version as its file contains it."""
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
    """Add a version with complete files; return its number. It is visible once the session commits.

    It serves from then on, unless it is a candidate. `start` is the number of the model's last event that the training
    includes; the default is the newest event. `promotion` records why the version serves or not.
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
    """Return the audit log's entry for a new version, with its source if it was imported."""
    imported = manifest["lineage"].get("imported", []) if job is None else []
    source = {name: imported[-1].get(name) for name in ("model", "version")} if imported else {}
    return {"estimator": manifest["estimator"], "job": job, **({"imported": source} if source else {})}


def _row(session: Session, model: str) -> ModelRow:
    """Return the row of a model, a new one if there is none.

    A new row continues the version numbers of a deleted model.
    """
    row = session.scalar(select(ModelRow).where(ModelRow.name == model))
    if row is None:
        deleted = session.get(DeletedModelRow, model)
        row = ModelRow(name=model, created_at=now(), last_version=0 if deleted is None else deleted.last_version)
        session.add(row)
        session.flush()
    return row


def check_robot(session: Session, model: str, kind: RobotKind) -> None:
    """Raise ConflictError if the model's first version belongs to another robot."""
    query = select(VersionRow).where(VersionRow.model == model).order_by(VersionRow.version).limit(1)
    first = session.scalar(query)
    found = None if first is None else RobotKind.of_manifest(first.manifest).difference(kind)
    if first is not None and found is not None:
        field, own, others = found
        raise ConflictError(
            f"model {model!r} is of another robot: its version {first.version} has {field} {own}; this one has "
            f"{others}. Choose another name"
        )


def serving_version(session: Session, model: str) -> int | None:
    """Return the number of the serving version, None if none serves."""
    chosen = session.get(ServingRow, model)
    return None if chosen is None else chosen.version


def has_model(session: Session, model: str) -> bool:
    """Return whether a model of this name exists."""
    return session.scalar(select(ModelRow.name).where(ModelRow.name == model)) is not None


def missing(session: Session, model: str, version: int | None) -> NotFoundError | NoServingVersionError:
    """Return the error for a missing version, or for its model if that is missing too.

    `version` is None for the serving version.
    """
    if not has_model(session, model):
        return not_found("model", model)
    if version is not None:
        return not_found("version", version)
    newest = session.scalar(select(func.max(VersionRow.version)).where(VersionRow.model == model))
    return NoServingVersionError(
        f"no version of model {model!r} serves, all are candidates: `lipserve models show {model}` says why, and "
        f"`lipserve models promote {model} {newest}` lets the newest serve"
    )


def exists(session: Session, model: str, version: int) -> bool:
    """Return whether a version exists."""
    return fetch(session, _VERSION, model=model, version=version).scalar() is not None


def serve(session: Session, model: str, version: int, takes_back: int | None = None) -> int:
    """Let a version serve and learn once the session commits; return the number of the change.

    The earlier version stops serving and learning. takes_back: see `note`. Raise NotFoundError if the version does not
    exist.
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
    """Record a move of an alias; `takes_back` is the number of the move that this one undoes."""
    audit.note(session, model, "alias moved", version, alias, before, version)
    move = AliasMoveRow(model=model, alias=alias, before=before, version=version, takes_back=takes_back, at=now())
    session.add(move)
    session.flush()


def pointers(database: Database, models: Collection[str] | None = None) -> dict[tuple[str, str], int]:
    """Return the version of each alias by (model, alias), of all models if None, except the alias `serving`."""
    query = select(AliasRow.model, AliasRow.alias, AliasRow.version)
    if models is not None:
        query = query.where(AliasRow.model.in_(models))
    with database.session() as session:
        return {(model, alias): version for model, alias, version in session.execute(query)}


def serving(database: Database, models: Collection[str]) -> dict[str, Serving]:
    """Return the serving version of each of these models; models without one are missing."""
    query = select(ServingRow.model, ServingRow.version, ServingRow.change).where(ServingRow.model.in_(models))
    with database.session() as session:
        return {model: Serving(version, change) for model, version, change in session.execute(query)}


def find(database: Database, model: str, version: int | None) -> VersionRow:
    """Return a version, the serving version if None; raise NotFoundError or NoServingVersionError."""
    with database.session() as session:
        number = serving_version(session, model) if version is None else version
        row = None if number is None else session.get(VersionRow, (model, number))
        if row is None:
            raise missing(session, model, version)
    return row


def find_named(database: Database, text: str) -> VersionRow:
    """Return the version for a text of the pattern `schema.VERSION`; raise NotFoundError or NoServingVersionError."""
    model, _, which = text.replace(":", "@").partition("@")
    number, alias = (which, "") if which.isdecimal() else ("", which)
    if alias in ("", SERVING):
        return find(database, model, int(number) if number else None)
    version = pointers(database, [model]).get((model, alias))
    if version is None:
        raise no_alias(database, model, alias)
    return find(database, model, version)


def no_alias(database: Database, model: str, alias: str) -> NotFoundError:
    """Return the error for a missing alias, or for the model if that is missing too."""
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
    names = ("model", "version", "created_at", "job", "note")
    about = {**{name: getattr(row, name) for name in names}, "tags": row.tags or []}
    options = verdict_options(database, [model]).get(model, OPTIONS)
    return Version(
        **about,
        components=list(offered_components(row.manifest["estimator"])),
        verdict=verdicts.of_version(row.manifest, options),
        **fields,
    )


def verdict_options(database: Database, models: Collection[str]) -> dict[str, VerdictOptions]:
    """Return the thresholds of models by name; those that do not exist are missing."""
    with database.session() as session:
        rows = session.scalars(select(ModelRow).where(ModelRow.name.in_(models)))
        return {row.name: verdicts.options_of(row) for row in rows}


def set_thresholds(database: Database, model: str, thresholds: Thresholds) -> Model:
    """Replace the thresholds of a model's verdicts; return the model; raise NotFoundError. What serves stays."""
    with database.transaction() as session:
        row = session.scalar(select(ModelRow).where(ModelRow.name == model))
        if row is None:
            raise not_found("model", model)
        before, after = row.thresholds, thresholds.model_dump()
        if after != before:
            audit.note(session, model, "thresholds set", before=before, after=after)
            row.thresholds = after
        return _show(session, row)


def page(database: Database, part: Page) -> ModelPage:
    """List models, newest first."""
    with database.session() as session:
        rows, following = read_page(session, ModelRow, part)
        return ModelPage(items=[_show(session, row) for row in rows], next_cursor=following)


def _show(session: Session, row: ModelRow) -> Model:
    versions = list(
        session.scalars(select(VersionRow).where(VersionRow.model == row.name).order_by(VersionRow.version))
    )
    aliases = session.scalars(select(AliasRow).where(AliasRow.model == row.name).order_by(AliasRow.alias))
    options = verdicts.options_of(row)
    return Model(
        name=row.name,
        created_at=row.created_at,
        latest_version=versions[-1].version,
        serving_version=serving_version(session, row.name),
        aliases={each.alias: each.version for each in aliases},
        thresholds=Thresholds(**(row.thresholds or {})),
        versions=[
            VersionSummary(
                version=v.version,
                created_at=v.created_at,
                note=v.note,
                tags=v.tags or [],
                estimator=v.manifest["estimator"],
                verdict=verdicts.of_version(v.manifest, options),
                promotion=v.manifest.get(PROMOTION),
            )
            for v in versions
        ],
    )


def rows_of(session: Session, keys: Collection[tuple[str, int]]) -> dict[tuple[str, int], VersionRow]:
    """Return versions by model and number; deleted ones are missing."""
    query = select(VersionRow).where(tuple_(VersionRow.model, VersionRow.version).in_(keys))
    return {(row.model, row.version): row for row in session.scalars(query)}


def count_unreadable(
    database: Database, files: Files, held: Collection[tuple[str, int]], damaged: Collection[tuple[str, int]]
) -> tuple[int, int]:
    """Return how many models have a serving version that cannot be read, and how many have a serving version.

    `held` are versions in memory, which answer even without files; `damaged` are versions whose files could not be
    read.
    """
    with database.session() as session:
        names = list(session.scalars(select(ModelRow.name)))
        rows = session.execute(select(VersionRow.model, VersionRow.version, VersionRow.folder))
        folders = {(model, version): folder for model, version, folder in rows}
    serves = {(model, each.version) for model, each in serving(database, names).items()}
    gone = [key for key in serves - set(held) if key in damaged or not files.has_version(folders.get(key, ""))]
    return len(gone), len(serves)
