"""A service beside others: it applies their changes when notified.

It also compares its memory with the database regularly.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import closing

from sqlalchemy import func, select

from service.foundation.errors import ServiceError
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import Database, EventRow, LearnerRow, VersionRow
from service.storage.database.engine import Notice

logger = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.1
"""First pause before the listener reconnects, s; doubled each time."""
FULL_CHECK_S = 5.0
"""Seconds between two comparisons of everything in memory with the database, in case a notice was lost."""


class Replication:
    """Follows the changes of other services, if they share the database. Close it before the service's parts.

    A new event in a log wakes the learner at once, from the listener's thread. All other changes are read in a second
    thread, one after the other, because it loads versions.
    """

    def __init__(self, learners: Learners) -> None:
        self._learners = learners
        self._changed = threading.Condition()
        self._models: set[str] = set()
        self._grown: set[str] = set()
        self._everything = self._ending = False
        self._woken: dict[str, int] = {}
        self._looker = threading.Thread(target=self._run, daemon=True, name="lipserve-replication")
        self._looker.start()
        self._listener = Listener(learners.database, self._note, self._note_everything)

    def close(self) -> None:
        """Stop both threads."""
        self._listener.close()
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._looker.join()

    def _note(self, notice: Notice) -> None:
        grown = notice.kind == "log"
        if grown:
            self._wake([notice.model])
        with self._changed:
            (self._grown if grown else self._models).add(notice.model)
            self._changed.notify_all()

    def _note_everything(self) -> None:
        with self._changed:
            self._everything = True
            self._changed.notify_all()

    def _run(self) -> None:
        due = time.monotonic() + FULL_CHECK_S
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._ending or self._everything or self._models or self._grown,
                    max(0.0, due - time.monotonic()),
                )
                if self._ending:
                    return
                everything, models, grown = self._everything, self._models, self._grown
                self._everything, self._models, self._grown = False, set(), set()
            try:
                if everything:
                    update_models(self._learners, None)
                elif models:
                    update_models(self._learners, models)
                    self._wake(models)  # roles may have changed
                self._learners.follow(grown & self._known())
                if everything or time.monotonic() >= due:
                    self._check_all_models()
                    due = time.monotonic() + FULL_CHECK_S
            except Exception as error:  # the database may be unreachable: retry, nothing is lost
                logger.warning("what other services have changed is not known now: %s", error)
                with self._changed:
                    self._models |= models
                    self._everything |= everything
                    self._changed.wait_for(lambda: self._ending, 1.0)

    def _check_all_models(self) -> None:
        """Compare all models in memory with the database, without a notice."""
        update_models(self._learners, self._known())
        behind = find_lagging_models(self._learners)
        self._wake(model for model, number in behind.items() if self._woken.get(model) != number)
        self._woken = behind  # once per event: a learner that cannot learn it retries by itself
        self._learners.follow()

    def _wake(self, models: Iterable[str]) -> None:
        for model in self._known().intersection(models):
            self._learners.process.wake(model)

    def _known(self) -> set[str]:
        return {model for model, _ in self._learners.loaded.versions_in_use()}


class Listener:
    """Receives the notices of other services in a thread of its own, and reconnects after each error.

    noticed: called with each notice. connected: called at each start of receiving, as earlier notices may be lost. Both
    are called in its thread and must not wait.
    """

    def __init__(self, database: Database, noticed: Callable[[Notice], None], connected: Callable[[], None]) -> None:
        self._database, self._noticed, self._connected = database, noticed, connected
        self._ending, self._receiving = threading.Event(), False
        self._thread = threading.Thread(target=self._run, daemon=True, name="lipserve-notices")
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._ending.is_set():
            try:
                self._listen()
            except Exception as error:  # any error: no other thread listens
                logger.warning("notices of other services are not heard now: %s", error)
            pause = min(2 * pause, 2.0) if not self._receiving else FIRST_PAUSE_S
            self._ending.wait(pause)

    def _listen(self) -> None:
        self._receiving = False
        with closing(self._database.changes_of_others(0.2)) as notices:  # s between two checks for the end
            for notice in notices:
                if self._ending.is_set():
                    return
                if not self._receiving:
                    self._receiving = True
                    self._connected()
                if notice is not None and notice.origin != self._database.origin:
                    self._noticed(notice)


def update_models(learners: Learners, models: Collection[str] | None) -> None:
    """Update serving versions, aliases and deletions of these models; of all models in memory if None.

    Blocking, as versions are loaded before they answer: use it in a thread.
    """
    known = {model for model, _ in learners.loaded.versions_in_use()} | learners.monitors().keys()
    here = known if models is None else known & set(models)
    learners.loaded.announce(here)
    _point(learners, models)
    _forget(learners, here)


def find_lagging_models(learners: Learners) -> dict[str, int]:
    """Return the models with a revision here that is behind their log, with the number of the log's newest event."""
    held = learners.loaded.versions_in_use()
    newest = select(func.max(EventRow.number)).where(EventRow.model == LearnerRow.model).scalar_subquery()
    query = select(LearnerRow.model, LearnerRow.version, LearnerRow.start, newest).where(
        LearnerRow.role == "serving", LearnerRow.model.in_({model for model, _ in held})
    )
    behind: dict[str, int] = {}
    with learners.database.session() as session:
        for model, version, start, number in session.execute(query):
            revision = held.get((model, version))
            if revision is not None and number is not None and number - start > revision:
                behind[model] = number
    return behind


def _point(learners: Learners, models: Collection[str] | None) -> None:
    """Update aliases from the database, and load their versions if the model is in use here."""
    loaded = learners.loaded
    used = {model for model, _ in loaded.versions()}
    moved = registry.pointers(learners.database, models).items() - loaded.snapshot.aliases.items()
    for (model, _), version in moved:
        if model in used:
            try:
                loaded.get(model, version)
            except ServiceError as error:  # the next query for it is answered with the error
                logger.warning("version %d of model %s, which an alias points to now: %s", version, model, error)
    with loaded.moving:  # read again: aliases that were moved here meanwhile are now in the database
        loaded.repoint(registry.pointers(learners.database, models), models)


def _forget(learners: Learners, models: Collection[str]) -> None:
    """Remove deleted versions from memory."""
    loaded = learners.loaded
    with loaded.moving:
        held = {key for key in loaded.versions_in_use() if key[0] in models}
        with learners.database.session() as session:
            rows = session.execute(select(VersionRow.model, VersionRow.version).where(VersionRow.model.in_(models)))
            kept = {(model, version) for model, version in rows}
        left = {model for model, _ in kept}
        for model in models:
            gone = {version for name, version in held - kept if name == model}
            serving = loaded.newest(model)
            # a model that was deleted and created again shares nothing with the one in memory
            everything = model not in left or (serving is not None and serving in gone)
            if gone or everything:
                loaded.forget(model, gone, everything)
                logger.info("another service has deleted %s of model %s", gone or "all versions", model)
