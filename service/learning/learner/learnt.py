"""What a version has learnt, for the process that serves: as much of it as can be learnt at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.record import Record, error_floor
from lipcore.online.transfer import consolidate
from service.journal import log, snapshots
from service.learning import owner
from service.learning.learner.restore import Restored, restore
from service.learning.payloads import Payloads
from service.learning.streams import Streams
from service.models.loads import Carried
from service.models.scales import Factor
from service.models.served import Learnt
from service.storage.database import Database, EventRow, LearnerRow
from service.storage.files import Files

MOST_ROWS = 500
"""Rows since the last snapshot that are learnt while a version is loaded, about: for more, a learner is needed."""
SECONDS = 2.0
FEWEST_ROWS = 200
MOST_EVENTS = 500
"""Batches that are looked at, at most."""
READ_EVENTS = 20
"""Batches that are read together: few are needed as a rule."""


def floor(database: Database, model: str, version: int, through: int, n_joints: int) -> Array:
    """Function variance (N·m)², (n,), that a version's latest errors up to event `through` prove: its std is no lower.

    The batches are those of the last SECONDS before the newest one came, and more until there are FEWEST_ROWS
    rows. A stream that did not fit from its first second on, and that nobody has confirmed, says nothing of this robot;
    nor does what waits for its owner's decision, or came while learning was paused.
    Like the learnt state, the floor is a function of the log up to that event, whatever was taken back since.
    """
    of_version = (EventRow.kind == "batch", EventRow.version == version)
    upto = (EventRow.model == model, EventRow.number <= through)
    clock = func.coalesce(EventRow.clock, EventRow.received)
    query = select(clock, EventRow.record).where(*upto, *of_version).order_by(EventRow.number.desc())
    records, rows = list[dict[str, Any]](), 0
    newest: float | None = None
    with database.session() as session:
        counts = EventRow.void.is_(False) | EventRow.number.in_(_undone_later(session, model, through))
        kept_out = (func.coalesce(EventRow.report[why].as_boolean(), False) for why in ("doubted", "aside"))
        latest = query.where(counts, *(each.is_(False) for each in kept_out)).limit(MOST_EVENTS)
        events = session.execute(latest.execution_options(yield_per=READ_EVENTS))
        for at, record in events:
            if record is None:
                continue
            newest = at if newest is None else newest
            if rows >= FEWEST_ROWS and at < newest - SECONDS:
                break
            records.append(record)
            rows += record["rows"]
        events.close()
    total = Record.empty(n_joints)
    if rows:  # all of them at once, and only what the floor is made of: it is asked for twice a second
        figures = np.array([[record["squared"], record["noise"]] for record in records])
        squared, noise = np.average(figures, axis=0, weights=[record["rows"] for record in records])
        total = replace(total, rows=rows, squared=squared, noise=noise)
    return error_floor(total)


def _undone_later(session: Session, model: str, through: int) -> list[int]:
    """Batches up to event `through` that count there and were taken back since; the newest ones, and seldom any."""
    kinds = EventRow.kind.in_(("unlearn", "rollback"))
    query = select(EventRow.number, EventRow.kind, EventRow.detail).where(EventRow.model == model, kinds)
    later = session.execute(query.where(EventRow.number > through)).all()
    if not later:
        return []
    lowest = min(each.detail["to"] + 1 if each.kind == "rollback" else each.detail["event"] for each in later)
    before = session.execute(query.where(EventRow.number > lowest, EventRow.number <= through)).all()
    undone = {each.detail["event"] for each in before if each.kind == "unlearn"}
    spans = [range(each.detail["to"] + 1, each.number) for each in before if each.kind == "rollback"]
    void = select(EventRow.number).where(
        EventRow.model == model, EventRow.kind == "batch", EventRow.void, EventRow.number >= lowest
    )
    numbers = session.scalars(void.where(EventRow.number <= through).order_by(EventRow.number.desc()))
    counted = [each for each in numbers if each not in undone and not any(each in span for span in spans)]
    return counted[:MOST_EVENTS]


class LearntVersions:
    """What versions have learnt, from the log and snapshots; see `models.served.LearntStates`."""

    def __init__(self, database: Database, files: Files) -> None:
        self._database, self._files = database, files

    def find(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """Return what a version has learnt, None where that is nothing. base: the version as trained. One that neither
        serves nor is a candidate no longer learns: its last snapshot, less what was unlearnt since."""
        state = _restored(self._database, self._files, model, version, base, MOST_ROWS)
        if state is None:
            return None
        known, start, newest = state
        behind = newest is not None and known.number < newest
        if known.number == start:
            return Learnt(base, 0, behind)
        variance = floor(self._database, model, version, known.number, base.n_joints)
        return Learnt(known.online.model(variance), known.number - start, behind)

    def carried(self, model: str, version: int, carrier: Carrier) -> Mapping[str, Carried]:
        """Return what answers for its streams with what their last batches say that they carry."""
        with self._database.session() as session:
            return Payloads.restored(session, model, Streams.restored(session, model)).carried(carrier, version)

    def factors(self, model: str, version: int) -> Mapping[str, Factor]:
        """Return the factors on its intervals that the last batches of its streams have led to."""
        with self._database.session() as session:
            kept = owner.options(session, model).adaptive_intervals
            return Streams.restored(session, model).factors(version) if kept else {}

    def consolidated(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """Return all that a version has learnt as a model that can be saved, None where that is nothing; see `find`. It
        takes the time to learn the log since the last snapshot."""
        state = _restored(self._database, self._files, model, version, base, None)
        if state is None or state[0].number == state[1]:
            return None
        known, start, _ = state
        variance = floor(self._database, model, version, known.number, base.n_joints)
        return Learnt(consolidate(known.online, variance), known.number - start, False)


def _restored(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, most_rows: int | None
) -> tuple[Restored, int, int | None] | None:
    """The state of a version, the event that it starts after, and the newest one, None where it no longer learns."""
    with database.session() as session:
        start, newest = log.start_of(session, model, version), log.newest(session, model)
        if newest == start:
            return None
        learns = _learns(session, model, version)
        row = snapshots.latest(session, model, version, None)
    if not learns and row is None:
        return None
    at_most = None if learns or row is None else row.number
    known = restore(database, files, model, version, base, at_most, most_rows=most_rows, taken_back=not learns)
    return known, start, newest if learns else None


def _learns(session: Session, model: str, version: int) -> bool:
    row = session.get(LearnerRow, (model, version))
    return row is not None and row.role in ("serving", "candidate")
