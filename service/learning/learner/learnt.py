"""The learnt states of versions, for the process that serves."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy.orm import Session

from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import consolidate
from service.journal import log, snapshots
from service.journal.floor import error_floor_of
from service.journal.restore import RestoredState, restore
from service.learning import owner
from service.learning.payloads import Payloads
from service.learning.streams import Streams
from service.models.loads import StreamPayload
from service.models.scales import Factor
from service.models.served import LearntState
from service.storage.database import Database, LearnerRow
from service.storage.files import Files

MAX_PAGES = 2
"""Max pages of the log learnt while a version is loaded. The learner process learns the others."""


class LearntVersions:
    """Loads learnt states from logs and snapshots; see `models.served.LearntStates`."""

    def __init__(self, database: Database, files: Files) -> None:
        self._database, self._files = database, files

    def find(self, model: str, version: int, base: TorqueModel) -> LearntState | None:
        """Return the learnt state of a version; None if it has learnt nothing. base: the version as trained.

        A version that does not serve no longer learns: it has the state of its last snapshot.
        """
        state = _restored(self._database, self._files, model, version, base, MAX_PAGES)
        if state is None:
            return None
        known, start, newest = state
        behind = newest is not None and known.number < newest
        if known.number == start:
            return LearntState(base, 0, behind)
        variance = error_floor_of(self._database, model, version, known.number, base.n_joints)
        return LearntState(known.online.model(variance), known.number - start, behind)

    def payloads(self, model: str, version: int, carrier: Carrier) -> Mapping[str, StreamPayload]:
        """Return the models that answer its streams with their last known payloads."""
        with self._database.session() as session:
            return Payloads.restored(session, model, Streams.restored(session, model)).build_models(carrier, version)

    def factors(self, model: str, version: int) -> Mapping[str, Factor]:
        """Return the interval factors after the last batch of each stream."""
        with self._database.session() as session:
            kept = owner.read_options(session, model).adaptive_intervals
            return Streams.restored(session, model).factors(version) if kept else {}

    def consolidated(self, model: str, version: int, base: TorqueModel) -> LearntState | None:
        """Return the complete learnt state of a version as a model to save; None if it has learnt nothing.

        This may be slow: it learns the whole log after the last snapshot.
        """
        state = _restored(self._database, self._files, model, version, base, None)
        if state is None or state[0].number == state[1]:
            return None
        known, start, _ = state
        variance = error_floor_of(self._database, model, version, known.number, base.n_joints)
        return LearntState(consolidate(known.online, variance), known.number - start, False)


def _restored(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, pages: int | None
) -> tuple[RestoredState, int, int | None] | None:
    """Return the state of a version, the event after which it starts, and the newest event.

    The newest event is None if the version no longer learns. All is None if the version has learnt nothing.
    """
    with database.session() as session:
        start, newest = log.start_of(session, model, version), log.newest(session, model)
        if newest == start:
            return None
        learns = _learns(session, model, version)
        row = snapshots.find_latest(session, model, version, None)
    if not learns and row is None:
        return None
    at_most = None if learns or row is None else row.number
    known = restore(database, files, model, version, base, at_most, pages)
    return known, start, newest if learns else None


def _learns(session: Session, model: str, version: int) -> bool:
    row = session.get(LearnerRow, (model, version))
    return row is not None and row.role == "serving"
