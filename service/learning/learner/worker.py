"""The work of the learner process: each serving version has a follower, and the followers take turns."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import suppress
from math import inf
from multiprocessing.connection import Connection

from service.foundation.settings import Settings
from service.journal import snapshots
from service.learning.learner import publication
from service.learning.learner.follower import Follower
from service.learning.learner.publication import LearningFailure, Message
from service.models import registry
from service.runtime.companion import BEAT, BEAT_S, receive_work
from service.storage.database import Database
from service.storage.files import Files

logger = logging.getLogger(__name__)

Key = tuple[str, int]
MIN_PAUSE_S, MAX_PAUSE_S = 1.0, 60.0
"""Seconds until a version that failed is tried again. The pause doubles each time, up to the max."""


def run(settings: Settings, connection: Connection) -> None:
    """Follow the models with names that arrive over the connection, until it ends or None arrives.

    Send a heartbeat after each step, at most every `BEAT_S`, and every `BEAT_S` while idle.
    """
    database, files = Database.of(settings), Files.of(settings)
    publication.clear(files)
    snapshots.sweep(database, files)
    learner = Learner(database, files, settings)
    try:
        with suppress(EOFError, ConnectionError):  # the service is gone
            beaten = time.monotonic()
            while (work := receive_work(connection, min(learner.pause(), BEAT_S))) is not None:
                learner.wake({str(model) for model in work})
                for message in learner.turn():
                    connection.send(message)
                if time.monotonic() - beaten >= BEAT_S:  # from the working thread, so that a hang stops the heartbeat
                    connection.send(BEAT)
                    beaten = time.monotonic()
        learner.close()
    finally:
        database.close()


class Learner:
    """The followers of all versions that learn, at most `max_loaded_models`."""

    def __init__(self, database: Database, files: Files, settings: Settings) -> None:
        self.database, self.files, self.settings = database, files, settings
        self.followers: dict[Key, Follower] = {}  # in the order in which they were woken last
        self._woken: set[str] = set()
        self._unread: dict[str, float] = {}  # when to look models up again after a database failure
        self._failed: dict[Key, tuple[float, float]] = {}

    def wake(self, models: set[str]) -> None:
        """Check these models in the next turn: their logs have grown, or other versions learn."""
        self._woken |= models

    def pause(self) -> float:
        """Return the seconds until there is work, if no message arrives."""
        times = [*self._unread.values(), *(at for at, _ in self._failed.values())]
        for follower in self.followers.values():
            if follower.behind:
                return 0.0
            times.append(follower.snapshot_due)
            if follower.woken or follower.unpublished:
                times.append(follower.due)
        return max(0.0, min(times, default=inf) - time.monotonic()) if not self._woken else 0.0

    def turn(self) -> Iterator[Message]:
        """Let every follower advance by one step, and yield the messages to the service."""
        now = time.monotonic()
        again = {model for (model, _), (at, _) in self._failed.items() if now >= at}
        again |= {model for model, at in self._unread.items() if now >= at}
        woken, self._woken = self._woken | again, set()
        for model in sorted(woken):
            yield from self._update_followers(model)
        for key, follower in list(self.followers.items()):
            try:
                yield from self._advance(follower)
            except Exception as error:  # the others still learn
                yield self._fail(key, error)

    def close(self) -> None:
        """Store the learnt states."""
        for key in list(self.followers):
            self._drop(key)

    def _advance(self, follower: Follower) -> Iterator[Message]:
        now = time.monotonic()
        if follower.behind or (follower.woken and now >= follower.due):
            follower.step()
        if follower.unpublished and now >= follower.due:
            yield follower.publish()
            self._failed.pop((follower.model, follower.version), None)
        if time.monotonic() >= follower.snapshot_due:
            follower.store_in_turn()

    def _update_followers(self, model: str) -> Iterator[Message]:
        """Wake the follower of the serving version and drop those of other versions."""
        try:
            with self.database.session() as session:
                version = registry.serving_version(session, model)
        except Exception:  # a database error: the follower keeps its state
            logger.exception("could not read which version of model %r learns; retrying", model)
            self._unread[model] = time.monotonic() + MIN_PAUSE_S
            return
        self._unread.pop(model, None)
        for key in [key for key in self.followers if key[0] == model and key[1] != version]:
            self._drop(key)
        self._failed = {key: tried for key, tried in self._failed.items() if key[0] != model or key[1] == version}
        if version is None:
            return
        key = (model, version)
        at, pause = self._failed.get(key, (0.0, 0.0))
        if at > time.monotonic() and key not in self.followers:
            return
        try:
            follower = self.followers.pop(key, None) or self._follow(key)
        except Exception as error:
            yield self._fail(key, error)
            return
        follower.woken = True
        self.followers[key] = follower
        if key in self._failed:
            self._failed[key] = (inf, pause)  # forgotten once it has published

    def _follow(self, key: Key) -> Follower:
        while len(self.followers) >= self.settings.max_loaded_models:
            self._drop(next(iter(self.followers)))
        row = registry.find(self.database, *key)
        base = self.files.load_version(row.folder, row.checksums)
        return Follower(self.database, self.files, self.settings, *key, base)

    def _drop(self, key: Key) -> None:
        follower = self.followers.pop(key)
        try:
            follower.store()
        except Exception:  # the log still has everything
            logger.exception("could not store the state of version %d of model %r", key[1], key[0])

    def _fail(self, key: Key, error: Exception) -> LearningFailure:
        logger.error("version %d of model %r cannot learn", key[1], key[0], exc_info=error)
        self.followers.pop(key, None)
        pause = min(2 * self._failed[key][1], MAX_PAUSE_S) if key in self._failed else MIN_PAUSE_S
        self._failed[key] = (time.monotonic() + pause, pause)
        return LearningFailure(*key, f"{type(error).__name__}: {error}")
