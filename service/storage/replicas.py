"""Services that share a database: each gives signs of life, and takes over jobs of those that no longer do.

Their age is told by the database's clock. A service alone gives no signs, and all jobs are its own.
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
"""Seconds between two searches for jobs that nobody has, of a service alone: only a fault leaves some."""
_SECONDS = cast(func.extract("epoch", func.clock_timestamp()), Float)


class Replicas:
    """A service among those that share its database; a thread gives its signs of life until it is closed.

    id: of this service, the same again after a restart on the same home, so that it knows its own jobs; beat_s: seconds
    between two signs of life; reconcile_s: between two searches for jobs that nobody has.
    """

    def __init__(self, settings: Settings, database: Database) -> None:
        self.settings, self.database = settings, database
        self.beat_s = settings.replica_lost_s / 10  # so many are missing before it counts as lost
        self.id = identity(settings.home) if database.shared else "alone"
        self.reconcile_s = self.beat_s if database.shared else RECONCILE_S
        self._started = now()
        self._since, self._last = float("inf"), -float("inf")  # monotonic, s: no sign was missed since; the last one
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if database.shared:
            self._beat()
            self._thread = threading.Thread(target=self._run, daemon=True, name="replica-beat")
            self._thread.start()

    def close(self) -> None:
        """Give no more signs; others need not wait to know it."""
        self._closing.set()
        if self._thread is None:
            return
        self._thread.join()
        try:
            with self.database.session() as session:
                session.execute(delete(ReplicaRow).where(ReplicaRow.id == self.id))
                session.commit()
        except Exception:  # as after a kill: others wait for the time
            logger.warning("the service could not take its leave of the others", exc_info=True)

    def others(self, session: Session) -> list[str]:
        """Ids of the other services that live, as far as is known."""
        return sorted(alive(session, self.settings.replica_lost_s) - {self.id})

    def mine(self, owner: str | None) -> bool:
        """Whether a job with this owner is this service's; one that nobody has is not, where there may be others."""
        return not self.database.shared or owner == self.id

    def free(self, session: Session) -> set[str | None]:
        """Owners whose jobs are to be had: of this service and nobody's, and those that live no more.

        While signs of this service could not be given for a time, nobody counts as lost: theirs could not be either.
        """
        owners = set(session.scalars(select(JobRow.owner).where(JobRow.state.in_(ACTIVE)).distinct()))
        if time.monotonic() - self._since < self.settings.replica_lost_s:
            return owners & {None, self.id}
        return owners - (alive(session, self.settings.replica_lost_s) - {self.id})

    def take(self, job: str, before: str | None) -> bool:
        """Make a job this service's own, if it still has the owner `before`: of several that try, one succeeds."""
        if not self.database.shared:
            return True
        owner = JobRow.owner.is_(None) if before is None else JobRow.owner == before
        ours = or_(owner, JobRow.owner == self.id)
        return self._change(update(JobRow).where(JobRow.id == job, JobRow.state.in_(ACTIVE), ours), self.id)

    def leave(self) -> None:
        """Let others have the jobs of this service."""
        if self.database.shared:
            self._change(update(JobRow).where(JobRow.owner == self.id, JobRow.state.in_(ACTIVE)), None)

    def _change(self, statement: Any, owner: str | None) -> bool:
        with self.database.session() as session:  # a single statement: it needs no lock of all writers
            changed = session.execute(statement.values(owner=owner).returning(JobRow.id)).all()
            session.commit()
        return bool(changed)

    def _run(self) -> None:
        while not self._closing.wait(self.beat_s):
            try:
                self._beat()
            except Exception as error:
                logger.warning("no sign of life could be given to other services: %s", error)

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


def alive(session: Session, lost_s: float) -> set[str]:
    """Ids of the services that gave a sign of life within so many seconds."""
    return set(session.scalars(select(ReplicaRow.id).where(ReplicaRow.seen_at > _SECONDS - lost_s)))


def identity(home: Path) -> str:
    """The id of the service on a home, which it keeps. Only the process that holds the home may ask."""
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
