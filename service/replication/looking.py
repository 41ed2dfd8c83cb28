"""What other services have changed, looked up in the database and taken in."""

from __future__ import annotations

import logging
from collections.abc import Collection

from sqlalchemy import func, select

from service.foundation.errors import ServiceError
from service.learning.updates import Updates
from service.models import moves
from service.storage.database import EventRow, LearnerRow, VersionRow

logger = logging.getLogger(__name__)


def look(updates: Updates, models: Collection[str] | None) -> None:
    """Take in which versions of these models serve, have aliases or are gone; of all that are known here where None.

    Not for the event loop: versions are loaded before they answer.
    """
    known = {model for model, _ in updates.loaded.held()} | updates.monitors().keys()
    here = known if models is None else known & set(models)
    updates.loaded.announce(here)
    _point(updates, models)
    _forget(updates, here)


def lagging(updates: Updates) -> dict[str, int]:
    """Models that answer here with less than their log holds, and the number of its newest event."""
    held = updates.loaded.held()
    newest = select(func.max(EventRow.number)).where(EventRow.model == LearnerRow.model).scalar_subquery()
    query = select(LearnerRow.model, LearnerRow.version, LearnerRow.start, newest).where(
        LearnerRow.role == "serving", LearnerRow.model.in_({model for model, _ in held})
    )
    found: dict[str, int] = {}
    with updates.database.session() as session:
        for model, version, start, number in session.execute(query):
            revision = held.get((model, version))
            if revision is not None and number is not None and number - start > revision:
                found[model] = number
    return found


def _point(updates: Updates, models: Collection[str] | None) -> None:
    """Let aliases point where the database says, to versions in memory where the model is in use here."""
    loaded = updates.loaded
    used = {model for model, _ in loaded.versions()}
    moved = moves.pointers(updates.database, models).items() - loaded.aliases().items()
    for (model, _), version in moved:
        if model in used:
            try:
                loaded.get(model, version)
            except ServiceError as error:  # who asks for it is told
                logger.warning("version %d of model %s, which an alias points to now: %s", version, model, error)
    with loaded.moving:  # read again: what is moved here meanwhile has been by now
        loaded.repoint(moves.pointers(updates.database, models), models)


def _forget(updates: Updates, models: Collection[str]) -> None:
    """Answer no more with versions that are gone."""
    loaded = updates.loaded
    with loaded.moving:
        held = {key for key in loaded.held() if key[0] in models}
        with updates.database.session() as session:
            rows = session.execute(select(VersionRow.model, VersionRow.version).where(VersionRow.model.in_(models)))
            kept = {(model, version) for model, version in rows}
        left = {model for model, _ in kept}
        for model in models:
            gone = {version for name, version in held - kept if name == model}
            serving = loaded.newest(model)
            # of a model that was deleted and made anew nothing that is known here holds any more
            whole = model not in left or (serving is not None and serving in gone)
            if gone or whole:
                loaded.forget(model, gone, whole)
                logger.info("another service has deleted %s of model %s", gone or "all versions", model)
