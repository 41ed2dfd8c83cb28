"""What a version has learnt, for the process that serves: as much of it as can be learnt at once."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy.orm import Session

from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import consolidate
from service.journal import log, snapshots
from service.journal.floor import error_floor_of
from service.journal.restore import Restored, restore
from service.learning import owner
from service.learning.payloads import Payloads
from service.learning.streams import Streams
from service.models.loads import Carried
from service.models.scales import Factor
from service.models.served import Learnt
from service.storage.database import Database, LearnerRow
from service.storage.files import Files

PAGES = 2
"""Pages of the log since the last snapshot that are learnt while a version is loaded: for more, a learner is needed."""


class LearntVersions:
    """What versions have learnt, from the log and snapshots; see `models.served.LearntStates`."""

    def __init__(self, database: Database, files: Files) -> None:
        self._database, self._files = database, files

    def find(self, model: str, version: int, base: TorqueModel) -> Learnt | None:
        """Return what a version has learnt, None where that is nothing. base: the version as trained. One that does not
        serve no longer learns: it has what its last snapshot has."""
        state = _restored(self._database, self._files, model, version, base, PAGES)
        if state is None:
            return None
        known, start, newest = state
        behind = newest is not None and known.number < newest
        if known.number == start:
            return Learnt(base, 0, behind)
        variance = error_floor_of(self._database, model, version, known.number, base.n_joints)
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
        variance = error_floor_of(self._database, model, version, known.number, base.n_joints)
        return Learnt(consolidate(known.online, variance), known.number - start, False)


def _restored(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, pages: int | None
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
    known = restore(database, files, model, version, base, at_most, pages)
    return known, start, newest if learns else None


def _learns(session: Session, model: str, version: int) -> bool:
    row = session.get(LearnerRow, (model, version))
    return row is not None and row.role == "serving"
