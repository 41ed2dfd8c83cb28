"""What a version has learnt, for the process that serves: as much of it as can be told at once."""

from __future__ import annotations

from sqlalchemy.orm import Session

from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import consolidate
from service.journal import log, snapshots
from service.learning.learner import recent
from service.learning.learner.restore import Restored, restore
from service.models.served import Learnt
from service.storage.database import Database, LearnerRow, ServingRow
from service.storage.files import Files

MOST_ROWS = 500
"""Rows since the last snapshot that are learnt while a version is loaded, about: for more, a learner is needed."""


class LearntVersions:
    """What versions have learnt, from the log and snapshots; see `models.served.LearntStates`."""

    def __init__(self, database: Database, files: Files) -> None:
        self._database, self._files = database, files

    def find(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """Return what a version has learnt, None where that is nothing. base: the version as trained.

        One that neither serves nor is a candidate has learnt what its last snapshot says, less what was unlearnt since.
        """
        state = _restored(self._database, self._files, model, version, base, MOST_ROWS)
        if state is None:
            return None
        known, start, newest = state
        behind = newest is not None and known.number < newest
        if known.number == start:
            return Learnt(base, 0, behind)
        floor = recent.floor(self._database, model, version, known.number, base.n_joints)
        return Learnt(known.online.model(floor), known.number - start, behind)

    def consolidated(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """Return all that a version has learnt as a model that can be saved, None where that is nothing; see `find`.

        It takes the time to learn what has come since the last snapshot.
        """
        state = _restored(self._database, self._files, model, version, base, None)
        if state is None or state[0].number == state[1]:
            return None
        known, start, _ = state
        floor = recent.floor(self._database, model, version, known.number, base.n_joints)
        return Learnt(consolidate(known.online, floor), known.number - start, False)


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
    if row is not None:
        return row.role in ("serving", "candidate")
    serving = session.get(ServingRow, model)
    return serving is None or serving.version == version
