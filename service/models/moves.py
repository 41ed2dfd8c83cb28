"""Where aliases point and how they came to point there: rows of the database, written inside its transactions."""

from __future__ import annotations

from collections.abc import Collection

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.storage.database import AliasMoveRow, AliasRow, Database, ServingRow, now

SERVING = "serving"
"""The alias that every model has: the version that answers where none is named."""


def pointers(database: Database, models: Collection[str] | None = None) -> dict[tuple[str, str], int]:
    """The version of every alias of these models, of all where None, by (model, alias), but for those that serve."""
    query = select(AliasRow.model, AliasRow.alias, AliasRow.version)
    if models is not None:
        query = query.where(AliasRow.model.in_(models))
    with database.session() as session:
        rows = session.execute(query).all()
    return {(model, alias): version for model, alias, version in rows}


def point(session: Session, model: str, alias: str, version: int | None, takes_back: int | None = None) -> None:
    """Point an alias to a version, or to none, and note the move; nothing happens where it points there already.

    Not for the alias `serving`, see `registry.serve`. takes_back: number of the move that is taken back by this one.
    """
    row = session.get(AliasRow, (model, alias))
    before = None if row is None else row.version
    if before == version:
        return
    note(session, model, alias, before, version, takes_back)
    if version is None:
        session.delete(row)
    elif row is None:
        session.add(AliasRow(model=model, alias=alias, version=version, changed_at=now()))
    else:
        row.version, row.changed_at = version, now()


def note(
    session: Session, model: str, alias: str, before: int | None, version: int | None, takes_back: int | None = None
) -> None:
    """Write a move down."""
    move = AliasMoveRow(model=model, alias=alias, before=before, version=version, takes_back=takes_back, at=now())
    session.add(move)
    session.flush()


def history(session: Session, model: str, alias: str, count: int) -> list[AliasMoveRow]:
    """The last moves of an alias, newest first, at most `count`."""
    query = select(AliasMoveRow).where(AliasMoveRow.model == model, AliasMoveRow.alias == alias)
    return list(session.scalars(query.order_by(AliasMoveRow.seq.desc()).limit(count)))


def standing(session: Session, model: str, alias: str) -> AliasMoveRow | None:
    """The move that a rollback takes back: the newest that neither took one back nor was taken back itself."""
    of_alias = (AliasMoveRow.model == model, AliasMoveRow.alias == alias)
    undone = select(AliasMoveRow.takes_back).where(*of_alias, AliasMoveRow.takes_back.is_not(None))
    query = select(AliasMoveRow).where(*of_alias, AliasMoveRow.takes_back.is_(None), AliasMoveRow.seq.not_in(undone))
    return session.scalar(query.order_by(AliasMoveRow.seq.desc()).limit(1))


def pointing(session: Session, model: str, version: int) -> list[str]:
    """Names of the aliases that point to a version, `serving` last."""
    query = select(AliasRow.alias).where(AliasRow.model == model, AliasRow.version == version)
    aliases = list(session.scalars(query.order_by(AliasRow.alias)))
    serves = select(ServingRow.model).where(ServingRow.model == model, ServingRow.version == version)
    return aliases if session.scalar(serves) is None else [*aliases, SERVING]


def count(session: Session, model: str) -> int:
    """How many aliases a model has, but for `serving`."""
    return session.scalar(select(func.count()).select_from(AliasRow).where(AliasRow.model == model)) or 0
