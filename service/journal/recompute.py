"""Recompute learnt states from the log, to verify the stored ones.

A snapshot is compared with the fold of the log since the snapshot before, or since the training. So the log is folded
once for all snapshots of a version. Events that retention has deleted cannot be folded: snapshots after such a gap are
not compared, but later ones are compared with them.
"""

from __future__ import annotations

import numpy as np
from safetensors.numpy import load
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.model.torque_model import TorqueModel
from lipcore.online import transfer
from lipcore.online.learner import OnlineModel
from service.journal import log
from service.journal.restore import RestoredState, fold_page, start_state
from service.storage.database import Database, EventRow

MAX_DIFFERENCE = 1e-6
"""Largest difference of an array from the stored one, relative to its largest number.

The same processor and release compute the same bits. Others may round differently.
"""


def state_as_trained(database: Database, model: str, version: int, base: TorqueModel) -> RestoredState:
    """Return the state of a version before its first event."""
    with database.session() as session:
        return start_state(session, model, version, base)


def recompute(database: Database, known: RestoredState, through: int) -> RestoredState | None:
    """Return the state after event `through`, folded from an earlier one.

    Return None if the log lacks events in between, or if one of them cannot be read.
    """
    state = known
    try:
        while state.number < through:
            state = fold_page(database, state, through)
    except ValueError:  # damaged rows are found by reading the log
        return None
    with database.session() as session:  # afterwards: retention may have deleted events meanwhile
        return state if log.is_complete(session, known.model, known.number, through) else None


def check_same(stored: OnlineModel, recomputed: OnlineModel) -> None:
    """Raise ValueError if two states differ by more than rounding."""
    one, other = (load(transfer.dump(each)) for each in (stored, recomputed))
    if one.keys() != other.keys():
        raise ValueError("the state has other parts than the log gives")
    for name, values in one.items():
        scale = MAX_DIFFERENCE * np.abs(values[np.isfinite(values)]).max(initial=1.0)
        if values.shape != other[name].shape or not np.allclose(values, other[name], 0.0, scale, equal_nan=True):
            raise ValueError(f"`{name}` of the state differs from the value recomputed from the log")


def find_gap(session: Session, model: str) -> tuple[int, int] | None:
    """Return the numbers of two events of a model between which others are missing; None if there is no such gap.

    Retention deletes the oldest events, but keeps settings.
    """
    before: int | None = None
    events = select(EventRow.number, EventRow.kind).where(EventRow.model == model).order_by(EventRow.number)
    for number, kind in session.execute(events.execution_options(yield_per=1000)):
        if before is not None and number != before + 1:
            return before, number
        before = number if before is not None or kind != "settings" else None
    return None
