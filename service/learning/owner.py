"""What a model's owner decides and has to know: options of learning, holds after a change, alarms."""

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

_SET = select(LearningRow.options, LearningRow.held).where(LearningRow.model == bindparam("model"))


def options(session: Session, model: str) -> LearningOptions:
    """What is set for a model, the defaults where nothing is."""
    row = fetch(session, _SET, model=model).first()
    return LearningOptions() if row is None else LearningOptions(**row.options)


def set_options(database: Database, model: str, chosen: LearningOptions, n_joints: int, received: float) -> None:
    """Set how a model learns from now on; a new time constant is an event of its log. Raise NotFoundError for a model
    that does not exist, InvalidRequestError where `torque_limits` is not of its joints."""
    limits = chosen.torque_limits
    if limits is not None and len(limits) != n_joints:
        raise invalid_request(
            "torque_limits", f"a list of {len(limits)}", f"{n_joints} positive numbers, one for each joint in order"
        )
    with database.turn(model), database.transaction(model) as session:
        row = _row(session, model)
        audit.note(session, model, "learning set", before=row.options, after=chosen.model_dump())
        row.options = chosen.model_dump()
        memory = log.Memory(chosen.forgetting_s, chosen.friction_walk_s)
        if memory != log.memory(session, model, log.newest(session, model)):
            log.append(session, model, "settings", memory.to_json(), received)


def hold(session: Session, model: str, detail: dict[str, Any]) -> None:
    """Let a model hold still: observations are answered and logged, but not learnt. detail: why."""
    _row(session, model).held = detail


def release(session: Session, model: str) -> None:
    """Let a model learn again; nothing happens where it does."""
    row = session.get(LearningRow, model)
    if row is not None:
        row.held = None


def held(session: Session, model: str) -> dict[str, Any] | None:
    """Why a model holds still; None where it learns."""
    row = fetch(session, _SET, model=model).first()
    return None if row is None else row.held


def declare(session: Session, model: str, payload: dict[str, Any]) -> None:
    """Keep what was declared of the payload of all streams, see `lipcore.online.stream.PayloadRecord`."""
    _row(session, model).payload = payload


def _row(session: Session, model: str) -> LearningRow:
    """The row of a model, a new one with the defaults where there is none."""
    row = session.get(LearningRow, model)
    if row is None:
        if session.scalar(select(ModelRow).where(ModelRow.name == model)) is None:
            raise not_found("model", model)
        row = LearningRow(model=model, options=LearningOptions().model_dump(), held=None)
        session.add(row)
    return row
