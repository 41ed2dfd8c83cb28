"""List, move, remove and roll back the aliases of versions. No query fails or waits while an alias moves."""

from __future__ import annotations

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session, aliased

from lipcore.estimators.base import RobotKind
from service.contract.models import Alias, AliasList, AliasMove, AliasRequest
from service.foundation.errors import ConflictError, invalid_request, not_found
from service.foundation.settings import Settings
from service.models import registry, texts, verdicts
from service.models.loaded import LoadedModels
from service.models.registry import CANDIDATE, SERVING
from service.storage.audit import oldest_kept
from service.storage.database import AliasMoveRow, AliasRow, Database, ServingRow, VersionRow, now

KEPT_MOVES = 20
"""Moves of an alias that are listed, and kept whatever their age."""


def page(loaded: LoadedModels, model: str) -> AliasList:
    """Return every alias of a model, `serving` first; raise NotFoundError."""
    # `moving`: an alias is listed only once queries follow it. `moment`: other services move and remove aliases too
    with loaded.moving, loaded.database.moment() as session:
        _check_model(session, model)
        serving = [] if registry.serving_version(session, model) is None else [SERVING]
        return AliasList(items=[_show(loaded, session, model, name) for name in (*serving, *names(session, model))])


def put(loaded: LoadedModels, model: str, alias: str, request: AliasRequest) -> Alias:
    """Point an alias, existing or new, to a version.

    The version is loaded and warm before the alias moves. Queries follow by one assignment; queries in flight keep
    their version. Raise InvalidRequestError unless exactly one of version and alias is given, NotFoundError,
    UnreadableVersionError, and ConflictError beyond MAX_ALIASES, for a version of another robot, or for one that is not
    usable by its verdict, unless the request overrides that. Blocking: use it in a thread.
    """
    if (request.version is None) == (request.alias is None):
        given = "neither" if request.version is None else "both"
        message = f"Expected either `version` or `alias`, got {given}."
        raise invalid_request("version or alias", given, "exactly one of the two", message)
    version = loaded.get(model, request.version, request.alias).version
    if alias != CANDIDATE and not request.override and loaded.storage.settings.promotion != "always":
        _check_verdict(loaded, model, version)
    return _move(loaded, model, alias, version)


def _check_verdict(loaded: LoadedModels, model: str, version: int) -> None:
    """Raise ConflictError unless the verdict on a version is usable."""
    options = registry.verdict_options(loaded.database, [model])[model]
    verdict = verdicts.of_version(registry.find(loaded.database, model, version).manifest, options)
    if not verdict.serves:
        raise ConflictError(texts.describe_refusal(version, texts.describe_verdict(verdict.label, verdict.reason)))


def rollback(loaded: LoadedModels, model: str, alias: str) -> Alias:
    """Undo the last move of an alias, removals included. A second call undoes the move before it.

    Raise NotFoundError if the alias never existed, UnreadableVersionError, and ConflictError if the alias pointed to
    nothing before or to a deleted version. Blocking: use it in a thread.
    """
    with loaded.database.session() as session:
        move = _last(session, model, alias)
        version = _before(session, move)
    loaded.get(model, version)
    return _move(loaded, model, alias, version, move)


def remove(loaded: LoadedModels, model: str, alias: str) -> None:
    """Remove an alias; raise NotFoundError, or ConflictError for `serving`. A rollback restores it."""
    with loaded.moving:
        with loaded.database.transaction() as session:
            _check_model(session, model)
            if alias == SERVING:
                raise ConflictError("the alias 'serving' is built in: it can be moved, but not removed")
            if session.get(AliasRow, (model, alias)) is None:
                raise not_found("alias", alias)
            point(session, model, alias, None)
        loaded.point(model, alias, None)


def _move(loaded: LoadedModels, model: str, alias: str, version: int, taken_back: AliasMoveRow | None = None) -> Alias:
    """Move an alias to a loaded version. `taken_back`: the move to undo, which must be the last one of the alias."""
    number = None if taken_back is None else taken_back.seq
    with loaded.moving:
        with loaded.database.transaction() as session:
            _check_model(session, model)
            if not registry.exists(session, model, version):  # deleted since it was found
                raise not_found("version", version)
            if taken_back is None:
                manifest = session.get_one(VersionRow, (model, version)).manifest
                registry.check_robot(session, model, RobotKind.of_manifest(manifest))
            elif _last(session, model, alias).seq != number:
                raise ConflictError(f"the alias {alias!r} of model {model!r} was moved meanwhile: check it, and retry")
            if alias == SERVING:
                registry.serve(session, model, version, number)
            else:
                _check_room(loaded, session, model, alias)
                point(session, model, alias, version, number)
            answer = _show(loaded, session, model, alias)
        if alias != SERVING:
            loaded.point(model, alias, version)
    if alias == SERVING:
        loaded.adopt(model)
        loaded.wake(model)
    return answer


def point(session: Session, model: str, alias: str, version: int | None, takes_back: int | None = None) -> None:
    """Point an alias to a version, or to none, and record the move; do nothing if it points there already.

    Not for the alias `serving`, see `registry.serve`. takes_back: see `registry.note`.
    """
    row = session.get(AliasRow, (model, alias))
    before = None if row is None else row.version
    if before == version:
        return
    registry.note(session, model, alias, before, version, takes_back)
    if version is None:
        session.delete(row)
    elif row is None:
        session.add(AliasRow(model=model, alias=alias, version=version, changed_at=now()))
    else:
        row.version, row.changed_at = version, now()


def _history(session: Session, model: str, alias: str, count: int) -> list[AliasMoveRow]:
    """Return the last moves of an alias, newest first, at most `count`."""
    query = select(AliasMoveRow).where(AliasMoveRow.model == model, AliasMoveRow.alias == alias)
    return list(session.scalars(query.order_by(AliasMoveRow.seq.desc()).limit(count)))


def standing(session: Session, model: str, alias: str) -> AliasMoveRow | None:
    """Return the move that a rollback undoes: the newest that is neither a rollback nor rolled back."""
    of_alias = (AliasMoveRow.model == model, AliasMoveRow.alias == alias)
    undone = select(AliasMoveRow.takes_back).where(*of_alias, AliasMoveRow.takes_back.is_not(None))
    query = select(AliasMoveRow).where(*of_alias, AliasMoveRow.takes_back.is_(None), AliasMoveRow.seq.not_in(undone))
    return session.scalar(query.order_by(AliasMoveRow.seq.desc()).limit(1))


def _last(session: Session, model: str, alias: str) -> AliasMoveRow:
    _check_model(session, model)
    move = standing(session, model, alias)
    if move is None and (alias == SERVING or _history(session, model, alias, 1)):
        raise ConflictError(f"the alias {alias!r} of model {model!r} has no move left to roll back")
    if move is None:
        raise not_found("alias", alias)
    return move


def _before(session: Session, move: AliasMoveRow) -> int:
    """Return the version that an alias pointed to before a move."""
    name = f"the alias {move.alias!r} of model {move.model!r}"
    if move.before is None:
        raise ConflictError(f"{name} pointed to no version before version {move.version}: move or remove it instead")
    if not registry.exists(session, move.model, move.before):
        raise ConflictError(f"version {move.before}, to which {name} pointed, has been deleted: choose another version")
    return move.before


def _check_model(session: Session, model: str) -> None:
    if not registry.has_model(session, model):
        raise not_found("model", model)


def clean(database: Database, settings: Settings) -> int:
    """Delete the moves older than the lines of the audit log that are kept, but for the last `KEPT_MOVES` of an alias.

    Return their number.
    """
    newer = aliased(AliasMoveRow)
    same = (newer.model == AliasMoveRow.model, newer.alias == AliasMoveRow.alias, newer.seq > AliasMoveRow.seq)
    later = select(func.count()).where(*same).correlate(AliasMoveRow).scalar_subquery()
    query = select(AliasMoveRow.seq).where(AliasMoveRow.at < oldest_kept(settings), later >= KEPT_MOVES)
    with database.session() as session:  # a transaction would block other writers
        old = list(session.scalars(query))
    if old:
        with database.transaction() as session:
            session.execute(delete(AliasMoveRow).where(AliasMoveRow.seq.in_(old)))
    return len(old)


def names(session: Session, model: str) -> list[str]:
    """Return the aliases of a model except `serving`, in alphabetical order."""
    return list(session.scalars(select(AliasRow.alias).where(AliasRow.model == model).order_by(AliasRow.alias)))


def _check_room(loaded: LoadedModels, session: Session, model: str, alias: str) -> None:
    known = names(session, model)
    if alias not in known and len(known) >= registry.MAX_ALIASES:
        raise ConflictError(f"model {model!r} already has {registry.MAX_ALIASES} aliases, the max: remove one first")


def _show(loaded: LoadedModels, session: Session, model: str, alias: str) -> Alias:
    past = _history(session, model, alias, KEPT_MOVES)
    if alias == SERVING:
        version = session.get_one(ServingRow, model).version
        changed_at = past[0].at if past else session.get_one(VersionRow, (model, version)).created_at
    else:
        row = session.get_one(AliasRow, (model, alias))
        version, changed_at = row.version, row.changed_at
    move = standing(session, model, alias)
    return Alias(
        alias=alias,
        version=version,
        changed_at=changed_at,
        previous=None if move is None else move.before,
        history=[
            AliasMove(version=each.version, before=each.before, at=each.at, rollback=each.takes_back is not None)
            for each in past
        ],
    )
