"""How a model learns, as its owner sets it, and what its owner decides once the robot has changed."""

from __future__ import annotations

import time
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError
from service.journal import alarms, log
from service.learning import learning
from service.learning.control import replaying, revisions
from service.learning.control.learning_schema import Alarm, AlarmPage, ChangeRequest, Decided
from service.learning.learning_options import LearningOptions
from service.learning.updates import Updates
from service.models import registry
from service.storage.database import AlarmRow, EventRow
from service.web.pagination import Page

CHANGE = "change"
CHUNK = 50
"""Batches whose rows are learnt after all in one transaction, so that observations do not wait long for the lock."""


def set_options(updates: Updates, model: str, wanted: LearningOptions) -> None:
    """Set how a model learns from now on; raise NotFoundError or InvalidRequestError."""
    joints = registry.find(updates.database, model, None).manifest["joint_names"]
    learning.set_options(updates.database, model, wanted, len(joints), time.time())
    updates.learner.wake(model)


def decide(updates: Updates, model: str, request: ChangeRequest) -> Decided:
    """End a hold; raise NotFoundError, or ConflictError where learning is not held.

    The change is logged first and the hold ends last. In between, the rows that were kept out are learnt some batches
    at a time: interrupted, it goes on where it was when it is asked for again.
    """
    version = revisions.serving(updates.database, model)
    rows, done, ended = 0, None, False
    while not ended:
        # a batch is judged and logged in its turn: none is judged as held and logged after the hold
        with updates.turn(model), updates.database.transaction(model) as session:
            held = _held(session, model)
            if request.decision == "adapt":
                _log_change(session, model, held)
            done = held["event"] - 1 if done is None else done
            pending = log.events(session, model, done, CHUNK) if request.replay else []
            rows += sum(_learn(session, event) for event in pending)
            ended = len(pending) < CHUNK
            if ended:
                learning.release(session, model)
            else:
                done = pending[-1].number
            revised = revisions.revised(session, model, version)
    updates.learner.wake(model)
    return Decided(**revised.model_dump(), decision=request.decision, at=held["at"], rows=rows)


def page(updates: Updates, model: str, part: Page) -> AlarmPage:
    """List the alarms of a model, newest first; raise NotFoundError where there is no such model."""
    registry.find(updates.database, model, None)
    with updates.database.session() as session:
        rows, following = alarms.page(session, model, part)
    return AlarmPage(items=[_alarm(row) for row in rows], next_cursor=following)


def _held(session: Session, model: str) -> dict[str, Any]:
    held = learning.held(session, model)
    if held is None:
        raise ConflictError(f"model {model!r} is not held for a change: there is nothing to decide")
    return held


def _alarm(row: AlarmRow) -> Alarm:
    shown = ("kind", "at", "message", "evidence")
    return Alarm.model_validate({"id": row.seq} | {name: getattr(row, name) for name in shown})


def _learn(session: Session, event: EventRow) -> int:
    """Learn the rows that a batch was held for; return how many. Other events have none."""
    return sum(replaying.admit(session, event, [CHANGE], time.time()).values()) if event.kind == "batch" else 0


def _log_change(session: Session, model: str, held: dict[str, Any]) -> None:
    """Log the change that learning is held for, unless an interrupted decision has."""
    query = select(EventRow.seq).where(
        EventRow.model == model, EventRow.number >= held["event"], EventRow.kind == "change", EventRow.void.is_(False)
    )
    if session.scalar(query.limit(1)) is None:
        log.append(session, model, "change", {"t": held["at"]}, time.time())
