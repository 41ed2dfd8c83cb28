"""Services that share a database: each sends heartbeats; jobs of services without them are taken over.

The database's clock dates the heartbeats. A single service sends none and owns all jobs.
"""

from __future__ import annotations

import logging
import re
import socket
import threading
import time
from pathlib import Path
from typing import Any

from sqlalchemy import Float, cast, delete, func, or_, select, update
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from service.contract.states import ACTIVE
from service.foundation.settings import Settings
from service.storage.database import Database, JobRow, ReplicaRow, now
from service.storage.files import new_id
from service.storage.files.local import write_durably

logger = logging.getLogger(__name__)

RECONCILE_S = 30.0
"""Seconds between two searches of a single service for jobs without an owner: only a fault leaves some."""
_SECONDS = cast(func.extract("epoch", func.clock_timestamp()), Float)


class Replicas:
    """A service among those that share its database; a thread sends its heartbeats until it is closed.

    - id: id of this service. It stays the same after a restart on the same home, so that it finds its own jobs.
    - beat_s: time between two heartbeats, s.
    - reconcile_s: time between two searches for jobs without an owner, s.
    """

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings, self.database = settings, database
        self.beat_s = settings.replica_lost_s / 10  # ten missing heartbeats count as lost
        self.id = load_replica_id(settings.home) if database.shared else "alone"
        self.reconcile_s = self.beat_s if database.shared else RECONCILE_S
        self._started = now()
        # monotonic, s: start of unbroken heartbeats; the last one
        self._since, self._last = float("inf"), -float("inf")
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if database.shared:
            self._beat()
            self._thread = threading.Thread(target=self._run, daemon=True, name="replica-beat")
            self._thread.start()

    def close(self) -> None:
        """Stop the heartbeats and delete the service's row, so that the others need not wait."""
        self._closing.set()
        if self._thread is None:
            return
        self._thread.join()
        try:
            with self.database.session() as session:
                session.execute(delete(ReplicaRow).where(ReplicaRow.id == self.id))
                session.commit()
        except Exception:  # then the others wait until this one counts as lost
            logger.warning("could not notify the other services that this one stops", exc_info=True)

    def others(self, session: Session) -> list[str]:
        """Return the ids of the other live services."""
        return sorted(read_live_ids(session, self.settings.replica_lost_s) - {self.id})

    def is_mine(self, owner: str | None) -> bool:
        """Return whether this service owns the jobs of an owner.

        Without an owner, a job belongs to a single service, but to none of several.
        """
        return not self.database.shared or owner == self.id

    def list_claimable_owners(self, session: Session) -> set[str | None]:
        """Return the owners of jobs that this service may claim: itself, None, and services that are lost.

        After a gap in this service's own heartbeats no service counts as lost for a time: the others may have had the
        same gap.
        """
        owners = set(session.scalars(select(JobRow.owner).where(JobRow.state.in_(ACTIVE)).distinct()))
        if time.monotonic() - self._since < self.settings.replica_lost_s:
            return owners & {None, self.id}
        return owners - (read_live_ids(session, self.settings.replica_lost_s) - {self.id})

    def claim(self, job: str, before: str | None) -> bool:
        """Become the owner of a job if its owner is still `before`: of several services, one succeeds."""
        if not self.database.shared:
            return True
        owner = JobRow.owner.is_(None) if before is None else JobRow.owner == before
        ours = or_(owner, JobRow.owner == self.id)
        return self._change(update(JobRow).where(JobRow.id == job, JobRow.state.in_(ACTIVE), ours), self.id)

    def release_jobs(self) -> None:
        """Release the jobs of this service for others."""
        if self.database.shared:
            self._change(update(JobRow).where(JobRow.owner == self.id, JobRow.state.in_(ACTIVE)), None)

    def _change(self, statement: Any, owner: str | None) -> bool:
        with self.database.session() as session:  # a single statement, which needs no lock of all writers
            changed = session.execute(statement.values(owner=owner).returning(JobRow.id)).all()
            session.commit()
        return bool(changed)

    def _run(self) -> None:
        while not self._closing.wait(self.beat_s):
            try:
                self._beat()
            except Exception as error:
                logger.warning("could not send a heartbeat to the other services: %s", error)

    def _beat(self) -> None:
        row = {"id": self.id, "host": socket.gethostname(), "started_at": self._started, "seen_at": _SECONDS}
        with self.database.session() as session:
            session.execute(
                insert(ReplicaRow).values(row).on_conflict_do_update(index_elements=[ReplicaRow.id], set_=row)
            )
            session.execute(delete(ReplicaRow).where(ReplicaRow.seen_at < _SECONDS - 3600.0))
            session.commit()
        clock = time.monotonic()
        if clock - self._last > self.settings.replica_lost_s / 2:
            self._since = clock
        self._last = clock


def read_live_ids(session: Session, lost_s: float) -> set[str]:
    """Return the ids of services with a heartbeat in the last `lost_s` seconds."""
    return set(session.scalars(select(ReplicaRow.id).where(ReplicaRow.seen_at > _SECONDS - lost_s)))


def load_replica_id(home: Path) -> str:
    """Return the lasting id of the service on a home. Call it only in the process that has the home's lock."""
    path = home / "replica"
    try:
        known = path.read_text().strip()
    except (FileNotFoundError, UnicodeDecodeError):
        known = ""
    if re.fullmatch(r"svc_[0-9a-z_]+", known):
        return known
    made = new_id("svc")
    write_durably(path, lambda file: file.write(f"{made}\n".encode()))
    return made
