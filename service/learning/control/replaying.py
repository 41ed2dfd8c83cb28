"""Learning rows after all that were kept out at first."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES, LEARNT
from service.foundation.errors import ConflictError, invalid_request
from service.journal import log
from service.learning.control import inspection, revisions
from service.learning.control.schema import REPLAYABLE, Replayed, ReplayRequest
from service.learning.control.undoing import find_learnt
from service.learning.updates import Updates
from service.storage.database import EventRow

TIME_JUMP = CODES.index("time_jump")


def replay(updates: Updates, model: str, stream_id: str, sequence: int, request: ReplayRequest) -> Replayed:
    """Learn the rows of a batch that some codes kept out, once each.

    Raise NotFoundError, InvalidRequestError where the batch has no such rows, ConflictError where it was undone or all
    of these rows have been replayed.
    """
    version = revisions.serving(updates.database, model)
    wanted = REPLAYABLE if request.codes is None else request.codes
    with updates.database.turn(model), updates.database.transaction(model) as session:
        batch = find_learnt(session, model, stream_id, sequence)
        learnt = admit(session, batch, wanted, time.time())
        if not learnt:
            raise _refusal(session, batch, wanted)
        revised = revisions.revised(session, model, version)
    updates.learner.wake(model)
    return Replayed(
        **revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=sum(learnt.values()), codes=learnt
    )


def admit(session: Session, batch: EventRow, codes: Collection[str], received: float) -> dict[str, int]:
    """Log that rows of a batch are learnt which these codes kept out and no replay has learnt; return their counts.

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


def _replayed(session: Session, batch: EventRow) -> set[str]:
    """Codes whose rows are learnt by now; what a rollback has undone can be replayed again."""
    events = inspection.replays(session, batch)
    return {code for event in events if not event.void for code in (event.detail or {})["codes"]}


def _complete(rows: Rows) -> NDArray[np.bool_]:
    """Rows all of whose numbers are known, (N,): where no acceleration could be derived there is none."""
    numbers = np.hstack([rows.time[:, None], rows.q, rows.dq, rows.ddq, rows.tau])
    return np.asarray(np.isfinite(numbers).all(axis=1))


def _refusal(session: Session, batch: EventRow, wanted: Collection[str]) -> Exception:
    """Why no row of a batch is left that could be learnt."""
    rows, name = inspection.rows_of(batch), f"batch {batch.sequence} of stream {batch.stream_id!r}"
    found = rows.take(_complete(rows)).rejected()
    offered = [code for code in REPLAYABLE if code in found]
    if done := [code for code in offered if code in wanted and code in _replayed(session, batch)]:
        return ConflictError(f"rows of {name} with the code {', '.join(done)} have been replayed: they are learnt once")
    has = f"those of {name} whose rows can be learnt: {', '.join(offered) or 'there are none'}"
    return invalid_request("codes", ", ".join(wanted), has)
