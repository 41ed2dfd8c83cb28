"""What the owner of a learning model decides: options, the end of a hold, replays; and the alarms that lead to it."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES, LEARNT
from service.foundation.errors import ConflictError, invalid_request
from service.journal import log
from service.learning import owner
from service.learning.control import inspection, undoing
from service.learning.control.schema import (
    REPLAYABLE,
    Alarm,
    AlarmPage,
    ChangeRequest,
    Decided,
    Replayed,
    ReplayRequest,
)
from service.learning.learners import Learners
from service.learning.schema import LearningOptions
from service.models import registry
from service.storage.database import AlarmRow, EventRow
from service.web.rows import Page

TIME_JUMP = CODES.index("time_jump")
CHANGE = "change"
CHUNK = 50
"""Batches whose rows are learnt after all in one transaction, so that observations do not wait long for the lock."""


def set_options(learners: Learners, model: str, options: LearningOptions) -> None:
    """Set how a model learns from now on; raise NotFoundError or InvalidRequestError."""
    joints = registry.find(learners.database, model, None).manifest["joint_names"]
    owner.set_options(learners.database, model, options, len(joints), time.time())
    learners.process.wake(model)


def decide(learners: Learners, model: str, request: ChangeRequest) -> Decided:
    """End a hold; raise NotFoundError, or ConflictError where learning is not held.

    The change is logged first and the hold ends last. In between, the rows that were kept out are learnt some batches
    at a time: interrupted, it goes on where it was when it is asked for again.
    """
    version = undoing.serving(learners.database, model)
    rows, done, ended = 0, None, False
    while not ended:
        # a batch is judged and logged in its turn: none is judged as held and logged after the hold
        with learners.turn(model), learners.database.transaction(model) as session:
            held = _held(session, model)
            if request.decision == "adapt":
                _log_change(session, model, held)
            done = held["event"] - 1 if done is None else done
            pending = log.events(session, model, done, CHUNK) if request.replay else []
            rows += sum(_learn(session, event) for event in pending)
            ended = len(pending) < CHUNK
            if ended:
                owner.release(session, model)
            else:
                done = pending[-1].number
            revised = undoing.revised_now(session, model, version)
    learners.process.wake(model)
    return Decided(**revised.model_dump(), decision=request.decision, at=held["at"], rows=rows)


def replay(learners: Learners, model: str, stream_id: str, sequence: int, request: ReplayRequest) -> Replayed:
    """Learn rows of a batch after all that were kept out with some codes, once each.

    Raise NotFoundError, InvalidRequestError where the batch has no such rows, ConflictError where it was undone or all
    of these rows have been replayed.
    """
    version = undoing.serving(learners.database, model)
    codes = REPLAYABLE if request.codes is None else request.codes
    with learners.database.turn(model), learners.database.transaction(model) as session:
        batch = undoing.find_learnt(session, model, stream_id, sequence)
        learnt = admit(session, batch, codes, time.time())
        if not learnt:
            raise _refusal(session, batch, codes)
        revised = undoing.revised_now(session, model, version)
    learners.process.wake(model)
    return Replayed(
        **revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=sum(learnt.values()), codes=learnt
    )


def admit(session: Session, batch: EventRow, codes: Collection[str], received: float) -> dict[str, int]:
    """Log a replay: the rows of a batch with these codes that no earlier replay has learnt; return their counts.

    Nothing is logged where there are none. Rows whose time was wrong count as of their arrival.
    """
    pending = set(codes) - _replayed(session, batch)
    rows = inspection.rows_of(batch)
    chosen = _complete(rows) & np.isin(rows.code, [CODES.index(code) for code in pending])
    taken = rows.take(chosen)
    counts = taken.rejected()
    if counts:
        times = np.where(taken.code == TIME_JUMP, batch.received, taken.time)
        learnt = replace(taken, time=times, code=np.full(len(taken), LEARNT, np.uint8))
        detail = {"event": batch.number, "codes": list(counts)}
        log.append(session, batch.model, "replay", detail, received, learnt)
    return counts


def alarms(learners: Learners, model: str, part: Page) -> AlarmPage:
    """List the alarms of a model, newest first; raise NotFoundError where there is no such model."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        rows, following = owner.alarms(session, model, part)
    return AlarmPage(items=[_alarm(row) for row in rows], next_cursor=following)


def _replayed(session: Session, batch: EventRow) -> set[str]:
    """Codes whose rows are learnt by now; what a rollback has undone can be replayed again."""
    events = inspection.replays(session, batch)
    return {code for event in events if not event.void for code in (event.detail or {})["codes"]}


def _complete(rows: Rows) -> NDArray[np.bool_]:
    """Rows all of whose numbers are known, (N,): where no acceleration could be derived there is none."""
    numbers = np.hstack([rows.time[:, None], rows.q, rows.dq, rows.ddq, rows.tau])
    return np.asarray(np.isfinite(numbers).all(axis=1))


def _refusal(session: Session, batch: EventRow, codes: Collection[str]) -> Exception:
    """Why no row of a batch is left that could be learnt."""
    rows, name = inspection.rows_of(batch), f"batch {batch.sequence} of stream {batch.stream_id!r}"
    counts = rows.take(_complete(rows)).rejected()
    offered = [code for code in REPLAYABLE if code in counts]
    if done := [code for code in offered if code in codes and code in _replayed(session, batch)]:
        return ConflictError(f"rows of {name} with the code {', '.join(done)} have been replayed: they are learnt once")
    has = f"those of {name} whose rows can be learnt: {', '.join(offered) or 'there are none'}"
    return invalid_request("codes", ", ".join(codes), has)


def _held(session: Session, model: str) -> dict[str, Any]:
    held = owner.held(session, model)
    if held is None:
        raise ConflictError(f"model {model!r} is not held for a change: there is nothing to decide")
    return held


def _alarm(row: AlarmRow) -> Alarm:
    names = ("kind", "at", "message", "evidence")
    return Alarm.model_validate({"id": row.seq} | {name: getattr(row, name) for name in names})


def _learn(session: Session, event: EventRow) -> int:
    """Learn the rows of a batch that were held for the change; return how many. Other events have none."""
    return sum(admit(session, event, [CHANGE], time.time()).values()) if event.kind == "batch" else 0


def _log_change(session: Session, model: str, held: dict[str, Any]) -> None:
    """Log the change that learning is held for, unless an interrupted decision has."""
    query = select(EventRow.seq).where(
        EventRow.model == model, EventRow.number >= held["event"], EventRow.kind == "change", EventRow.void.is_(False)
    )
    if session.scalar(query.limit(1)) is None:
        log.append(session, model, "change", {"t": held["at"]}, time.time())
