"""A service beside others: it hears what they change, takes it in, and looks for itself now and then."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable

from service.learning.updates import Updates
from service.replication.listening import Listener
from service.replication.looking import lagging, look
from service.storage.database.engine import Notice

logger = logging.getLogger(__name__)

LOOK_S = 5.0
"""Seconds between two looks at everything in memory: notices come in milliseconds, and should one be lost, this."""


class Replication:
    """Made once the service is, where it shares its database; close it before the service's parts.

    A log that has grown wakes the learner at once, from the thread that hears of it. All else is looked up in another
    thread, one look at a time, because versions are loaded for it.
    """

    def __init__(self, updates: Updates) -> None:
        self._updates = updates
        self._changed = threading.Condition()
        self._models: set[str] = set()
        self._everything = self._ending = False
        self._woken: dict[str, int] = {}
        self._looker = threading.Thread(target=self._run, daemon=True, name="lipserve-replication")
        self._looker.start()
        self._listener = Listener(updates.database, self._heard, self._missed)

    def close(self) -> None:
        """End both threads."""
        self._listener.close()
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._looker.join()

    def _heard(self, notice: Notice) -> None:
        if notice.kind == "log":
            self._wake([notice.model])
            return
        with self._changed:
            self._models.add(notice.model)
            self._changed.notify_all()

    def _missed(self) -> None:
        with self._changed:
            self._everything = True
            self._changed.notify_all()

    def _run(self) -> None:
        due = time.monotonic() + LOOK_S
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ending or self._everything or self._models, max(0.0, due - time.monotonic())
                )
                if self._ending:
                    return
                everything, models = self._everything, self._models
                self._everything, self._models = False, set()
            try:
                if everything:
                    look(self._updates, None)
                elif models:
                    look(self._updates, models)
                    self._wake(models)  # roles may have changed
                if everything or time.monotonic() >= due:
                    self._look_around()
                    due = time.monotonic() + LOOK_S
            except Exception as error:  # the database may be away: it is looked for again, and nothing is lost
                logger.warning("what other services have changed is not known now: %s", error)
                with self._changed:
                    self._models |= models
                    self._everything |= everything
                    self._changed.wait_for(lambda: self._ending, 1.0)

    def _look_around(self) -> None:
        """Look at all that is in memory, as if nobody had told anything."""
        look(self._updates, self._known())
        found = lagging(self._updates)
        self._wake(model for model, number in found.items() if self._woken.get(model) != number)
        self._woken = found  # once for an event: who cannot learn it tries again without being told
        self._updates.follow()

    def _wake(self, models: Iterable[str]) -> None:
        for model in self._known().intersection(models):
            self._updates.learner.wake(model)

    def _known(self) -> set[str]:
        return {model for model, _ in self._updates.loaded.held()}
