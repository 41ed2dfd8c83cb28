"""A version that follows the log of its model: it learns page by page, solves and stores its state."""

from __future__ import annotations

import logging
import time
from collections import deque

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.exc import DBAPIError

from lipcore.data.samples import Array
from lipcore.model.parameters import NegativeFriction, negative_friction
from lipcore.model.torque_model import TorqueModel
from lipcore.model.warnings import linearisation_error
from lipcore.online import transfer as state
from lipcore.online.learner import OnlineModel
from lipcore.online.transfer import Revision
from service.foundation.errors import StorageFullError
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.journal.floor import error_floor_of
from service.journal.restore import advance, restore
from service.learning.learner import publication
from service.learning.learner.publication import Publication
from service.storage.database import Database
from service.storage.disk import Disk
from service.storage.errors import translate_error
from service.storage.files import Files

logger = logging.getLogger(__name__)

NOVELTY_ROWS = 2000
"""Rows over which the share beyond the basis is taken."""
SNAPSHOT_PERIODS = 60
"""Time between two snapshots of a version's state, in units of `publish_every_s`: 30 s by default."""


class Novelty:
    """Counts the learnt rows beyond a version's basis. window: number of rows for `share`."""

    def __init__(self, window: int) -> None:
        self.rows = 0
        self._flags: deque[bool] = deque(maxlen=window)

    def add(self, novel: NDArray[np.bool_]) -> None:
        """Count rows. novel: whether each lies beyond the basis, (N,)."""
        self._flags.extend(novel.tolist())
        self.rows += int(novel.sum())

    @property
    def share(self) -> float:
        """Share of the last rows beyond the basis; 0 until the window is full."""
        full = len(self._flags) == self._flags.maxlen
        return sum(self._flags) / len(self._flags) if full else 0.0


class Follower:
    """A version in the learner process. Times are seconds of `time.monotonic`.

    base: the version as trained. known: its learnt state.
    """

    def __init__(
        self, database: Database, files: Files, settings: Settings, model: str, version: int, base: TorqueModel
    ) -> None:
        self.database, self.files, self.settings = database, files, settings
        self.model, self.version, self.base = model, version, base
        self.disk = Disk(settings)
        self.snapshot_every_s = SNAPSHOT_PERIODS * settings.publish_every_s
        with database.session() as session:
            self.start = log.start_of(session, model, version)
        # load the snapshot only. Pages are learnt one by one later, so that other versions advance in between
        self.known = restore(database, files, model, version, base, pages=0)
        self.novelty = Novelty(NOVELTY_ROWS)
        self.woken, self.behind = True, True
        self.due = 0.0
        self._solved: tuple[OnlineModel, Array] | None = None
        self._revision: Revision | None = None
        self._linearisation: tuple[float, ...] | None = None
        self._friction: tuple[NegativeFriction, ...] = ()
        self._published = self.start
        self._stored, self._stored_at = self.known.number, time.monotonic()
        self._snapshot: str | None = None
        self._seconds = 0.0

    @property
    def number(self) -> int:
        """Number of the last event that the state contains."""
        return self.known.number

    def step(self) -> None:
        """Learn the next page, if there is one. `behind` is whether there may be more."""
        began = time.monotonic()
        following = advance(self.database, self.files, self.known, novel=self.novelty.add)
        self.behind = self.woken = following is not self.known
        self.known = following
        self._seconds += time.monotonic() - began

    @property
    def unpublished(self) -> bool:
        """Whether the state contains events that are not published."""
        return self.known.number > self._published

    def publish(self) -> Publication:
        """Solve, write the arrays for the service, and return the message about them."""
        began = time.monotonic()
        variance = error_floor_of(self.database, self.model, self.version, self.number, self.base.n_joints)
        revision = self._solve(variance)
        path = publication.write(publication.folder(self.files), revision)
        ended = time.monotonic()
        message = Publication(
            model=self.model,
            version=self.version,
            revision=self.number - self.start,
            number=self.number,
            path=path,
            samples=self.known.online.samples,
            novel_rows=self.novelty.rows,
            novel_share=self.novelty.share,
            seconds=self._seconds + ended - began,
            at=time.time(),
            linearisation=self._linearisation,
            negative_friction=self._friction,
        )
        self._published, self._seconds = self.number, 0.0
        # at most half of the time is for solving
        self.due = max(began + self.settings.publish_every_s, ended + (ended - began))
        return message

    @property
    def snapshot_due(self) -> float:
        """Time at which the state must be stored; infinity if it is stored already."""
        if self.number == self._stored:
            return np.inf
        return self._stored_at + self.snapshot_every_s

    def store_in_turn(self) -> None:
        """Store the state unless another service has stored one within `snapshot_every_s`.

        One service stores for all of them, because they learn the same.
        """
        with self.database.session() as session:
            last = snapshots.find_last_stored(session, self.model, self.version)
        since = None if last is None or last[0] == self._snapshot else time.time() - last[1]
        # a time in the future means that clocks differ or that one was set back: ignored
        if since is not None and 0 <= since < self.snapshot_every_s:
            self._stored_at = time.monotonic()
            return
        self.store()

    def store(self) -> None:
        """Store the state, unless it or a later one is stored.

        Learning continues if the disk is full, because the log has everything.
        """
        if self.number == self._stored or self._is_stored():
            return
        self._stored_at = time.monotonic()
        payload = state.dump(self.known.online)
        try:
            self.disk.reserve(len(payload))
            self._snapshot = snapshots.save(
                self.database,
                self.files,
                self.model,
                self.version,
                self.number,
                self.known.seen,
                payload,
                most=self.settings.max_snapshots,
            )
        except (StorageFullError, OSError, DBAPIError) as error:
            reason = translate_error(error)
            if reason is None:
                raise
            logger.warning("could not store the state of version %d of model %s: %s", self.version, self.model, reason)
            return
        self._stored = self.number

    def _is_stored(self) -> bool:
        """Return whether this state or a later one is stored."""
        with self.database.session() as session:
            row = snapshots.find_latest(session, self.model, self.version, None)
        return row is not None and row.number >= self.number

    def _solve(self, floor: Array) -> Revision:
        """Return the arrays of the state; the last ones if nothing but the number has changed."""
        online = self.known.online
        known, at = self._solved or (None, floor)
        if self._revision is None or known is not online or not np.array_equal(at, floor):
            answering = online.model(floor)
            self._revision, self._solved = Revision.of(answering), (online, floor)
            error = linearisation_error(answering)
            # a joint with errors no larger than stated needs no refresh
            self._linearisation = None if error is None else tuple(np.where(floor > 0, error, 0.0).tolist())
            self._friction = negative_friction(answering.posterior, answering.estimator)
        return self._revision
