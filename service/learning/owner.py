"""The owner's settings of a model that learns: options, pauses and the payload of all streams."""

from __future__ import annotations

from typing import Any

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from service.contract.observations import (
    LearningOptions,
)
from service.foundation.errors import invalid_request, not_found
from service.journal import log
from service.storage import audit
from service.storage.database import Database, LearningRow, ModelRow, fetch

_SETTINGS = select(LearningRow.options, LearningRow.held).where(LearningRow.model == bindparam("model"))


def read_options(session: Session, model: str) -> LearningOptions:
    """Return the learning options of a model, the defaults if none are set."""
    row = fetch(session, _SETTINGS, model=model).first()
    return LearningOptions() if row is None else LearningOptions(**row.options)


def set_options(database: Database, model: str, chosen: LearningOptions, n_joints: int, received: float) -> None:
    """Set how a model learns from now on. A new time constant becomes an event of the log.

    Raise NotFoundError for an unknown model, and InvalidRequestError if `torque_limits` does not match its joints.
    """
    limits = chosen.torque_limits
    if limits is not None and len(limits) != n_joints:
        expected = f"{n_joints} positive numbers, one for each joint in order"
        message = f"`torque_limits` has {len(limits)} values; this model has {n_joints} joints."
        raise invalid_request("torque_limits", f"{len(limits)} values", expected, message)
    with database.turn(model), database.transaction(model) as session:
        row = _row(session, model)
        audit.note(session, model, "learning set", before=row.options, after=chosen.model_dump())
        row.options = chosen.model_dump()
        memory = log.Memory(chosen.forgetting_s, chosen.friction_walk_s)
        if memory != log.memory(session, model, log.newest(session, model)):
            log.append(session, model, "settings", memory.to_json(), received)


def pause(session: Session, model: str, detail: dict[str, Any]) -> None:
    """Pause learning: observations are answered and logged, but not learnt. detail: the reason."""
    _row(session, model).held = detail


def resume(session: Session, model: str) -> None:
    """Resume learning if it is paused."""
    row = session.get(LearningRow, model)
    if row is not None:
        row.held = None


def read_pause(session: Session, model: str) -> dict[str, Any] | None:
    """Return why learning is paused; None if it is not."""
    row = fetch(session, _SETTINGS, model=model).first()
    return None if row is None else row.held


def store_payload(session: Session, model: str, payload: dict[str, Any]) -> None:
    """Store the payload declared for all streams, see `lipcore.online.stream.PayloadRecord`."""
    _row(session, model).payload = payload


def _row(session: Session, model: str) -> LearningRow:
    """Return the row of a model, a new one with the defaults if there is none."""
    row = session.get(LearningRow, model)
    if row is None:
        if session.scalar(select(ModelRow).where(ModelRow.name == model)) is None:
            raise not_found("model", model)
        row = LearningRow(model=model, options=LearningOptions().model_dump(), held=None)
        session.add(row)
    return row
