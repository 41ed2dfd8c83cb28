"""Model versions in memory. Hot routes read them without a lock and without the database."""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from weakref import WeakValueDictionary

from lipcore.online.transfer import Revision
from service.contract.states import PartState
from service.foundation.errors import NotFoundError, UnreadableVersionError
from service.models import registry
from service.models.changes import Changes
from service.models.loading import Store, VersionLoader, freeze_version, warmed
from service.models.registry import SERVING, Serving
from service.models.scales import Scales
from service.models.served import Alias, Key, LearntStates, RevisionWaiters, ServedModel
from service.models.snapshot import Snapshot
from service.storage.database import VersionRow
from service.storage.storage import Storage

logger = logging.getLogger(__name__)

__all__ = ["LoadedModels", "ServedModel"]


class LoadedModels:
    """Cache of loaded versions; safe to share between threads.

    Beyond `capacity`, a setting, the least recently used versions are dropped. A version starts to answer once it is in
    memory and warm, by one assignment. Queries in flight keep theirs, and none waits. Revisions and aliases change in
    the same way.

    store: stores the arrays of versions and revisions where other processes can use them; None if no other does.
    """

    def __init__(
        self, storage: Storage, learnt: LearntStates, capacity: int | None = None, store: Store | None = None
    ) -> None:
        self.storage, self.settings, self.learnt = storage, storage.settings, learnt
        self.database, self.files = storage.database, storage.files
        self.capacity = storage.settings.max_loaded_models if capacity is None else capacity
        self.when_deleted: list[Callable[[str], None]] = []
        """Functions called with the name of a deleted model."""
        self._lagging: set[str] = set()
        self._wake: Callable[[str], None] = self._lagging.add
        self._revisions: dict[Key, tuple[int, Revision]] = {}
        self._held: WeakValueDictionary[Key, ServedModel] = WeakValueDictionary()  # streams keep dropped versions
        self._revising = threading.Lock()
        self._snapshot = Snapshot(aliases=registry.pointers(storage.database))
        self.changes = Changes()  # of versions, revisions, aliases, width factors and payloads
        self._store = store or (lambda value: value)
        self._loader = VersionLoader(self.database, self.files, learnt, self.changes.note, self._store)
        self._lock = threading.Lock()
        self.moving = threading.Lock()
        """Lock for moves of aliases and deletions of versions. Its holder changes the database, then this object."""
        self.waiters = RevisionWaiters()
        """Queries that wait for a revision."""
        self._loading: dict[Key, threading.Lock] = {}
        self._clock = itertools.count()
        self._used: dict[Key, int] = {}

    @property
    def snapshot(self) -> Snapshot:
        """What answers now."""
        return self._snapshot

    def hot(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version, or the version of an alias, if it is in memory; never waits.

        Without a version and an alias, or with the alias `serving`, return the serving version.
        """
        if (served := self._snapshot.find(model, version, alias)) is not None:
            self._used[served.name, served.version] = next(self._clock)
        return served

    def note_use(self, keys: Iterable[Key]) -> None:
        """Count uses of versions by another process, the last one last."""
        served = self._snapshot.served
        self._used.update((key, next(self._clock)) for key in keys if key in served)

    def peek(self, model: str) -> ServedModel | None:
        """Return the serving version if it is in memory; never waits. The call does not count as use."""
        return self._snapshot.find(model, None)

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the number of the version of an alias, or of the serving version, even if dropped; never waits."""
        return self._snapshot.pointed(model, alias)

    def is_deleted(self, model: str, version: int) -> bool:
        """Return whether a version was deleted since the service started; never waits."""
        return (model, version) in self._snapshot.deleted

    def get(self, model: str, version: int | None, alias: str | None = None) -> ServedModel:
        """Return a version, or the version of an alias; load it if necessary. Blocking: use it in a thread.

        Without both, return the serving version. Raise NotFoundError or UnreadableVersionError.
        """
        served = self.hot(model, version, alias)
        while served is None:
            number, serving = self.resolve_version(model, version, alias)
            try:
                served = self._load(registry.find(self.database, model, number), serving)
            except NotFoundError:
                if self.resolve_version(model, version, alias)[0] == number:
                    raise  # else the alias has moved, and its earlier version was deleted
        return served

    def resolve_version(self, model: str, version: int | None, alias: str | None) -> tuple[int | None, Serving | None]:
        """Return the number of a version, and its `Serving` record if it serves; raise NotFoundError."""
        if version is not None:
            return version, None
        if alias is None or alias == SERVING:
            serving = registry.serving(self.database, [model]).get(model)
            return (None, None) if serving is None else (serving.version, serving)
        number = self.newest(model, alias)
        if number is None:
            raise registry.no_alias(self.database, model, alias)
        return number, None

    def point(self, model: str, alias: str, version: int | None) -> None:
        """Point an alias to a version, or to none. The caller holds `moving` and has changed the database."""
        with self._lock:
            self._snapshot = self._snapshot.with_alias(model, alias, version)
        self._report_change((model,))

    def repoint(self, aliases: Mapping[Alias, int], models: Collection[str] | None) -> None:
        """Replace the aliases of these models, of all models if None.

        The caller holds `moving` and has changed the database.
        """
        with self._lock:
            self._snapshot = self._snapshot.with_aliases(aliases, models)
        self._report_change({model for model, _ in aliases})

    def forget(self, model: str, versions: Collection[int], entirely: bool = False) -> None:
        """Stop answering with deleted versions; the caller holds `moving`.

        `entirely`: the model was deleted too. Queries in flight keep their version. Call this before the files are
        removed, so that a reader that finds no file finds the reason here.
        """
        gone = {(model, version) for version in versions}
        with self._revising, self._lock:
            self._snapshot = self._snapshot.without_deleted(gone, model if entirely else None)
            for key in gone:
                self._revisions.pop(key, None)
                self._held.pop(key, None)
                self._used.pop(key, None)
            self._loader.forget(gone)
        self._report_change((model,))
        if entirely:
            for deleted in self.when_deleted:
                deleted(model)

    def announce(self, models: Collection[str]) -> None:
        """Load the versions of these models that now serve. Blocking: use it in a thread."""
        known = self._snapshot.serving  # other models are loaded by their first query
        for model, serving in registry.serving(self.database, [each for each in models if each in known]).items():
            if serving.change > known[model].change:
                self.adopt(model)

    def changed(self, model: str) -> None:
        """Follow a job's changes to a model: its serving version and its aliases. Blocking: use it in a thread."""
        with self.moving:
            self.repoint(registry.pointers(self.database, [model]), [model])
        self.adopt(model)

    def adopt(self, model: str) -> None:
        """Load the version of a model that now serves, and answer with it. Blocking: use it in a thread."""
        for serving in registry.serving(self.database, [model]).values():
            self._adopt(model, serving)

    def _adopt(self, model: str, serving: Serving) -> bool:
        try:
            self._load(registry.find(self.database, model, serving.version), serving)
            return True
        except (UnreadableVersionError, OSError) as error:  # the earlier version keeps answering
            logger.error("%s", error)
        except NotFoundError:  # deleted: another version serves and is loaded separately
            logger.info("version %d of model %s was deleted before it served", serving.version, model)
        return False

    def versions_in_use(self) -> dict[Key, int | None]:
        """Return the versions in use here and their revisions: in memory, used by streams, or serving.

        The revision is None for a serving version that was dropped from memory.
        """
        snapshot = self._snapshot
        revisions: dict[Key, int | None] = {(model, each.version): None for model, each in snapshot.serving.items()}
        streamed = [each for ref in self._held.valuerefs() if (each := ref()) is not None]
        return revisions | {(each.name, each.version): each.revision for each in (*streamed, *snapshot.served.values())}

    def versions(self) -> Collection[Key]:
        """Return the versions in memory; the call does not count as use."""
        return self._snapshot.served.keys()

    def check(self, lasting: object = None) -> tuple[PartState, str]:
        """Return whether the serving versions can be read, for readiness."""
        lost, models = registry.count_unreadable(self.database, self.files, self.versions(), self.unreadable())
        if not lost:
            return "ok", f"{models} can be read"
        state: PartState = "failed" if lost == models else "warning"
        return state, f"{lost} of {models} cannot be read: `lipserve verify` names them"

    def unreadable(self) -> dict[Key, str]:
        """Return the versions that failed to load at their last use, and why."""
        return self._loader.unreadable()

    def learn_from(self, wake: Callable[[str], None]) -> None:
        """Register the learner: `wake` is called with a model's name when a version is loaded that lags behind its log.

        It is called at once for the versions already loaded like that.
        """
        self._wake = wake
        while self._lagging:
            wake(self._lagging.pop())

    def wake(self, model: str) -> None:
        """Wake the learner of a model, as its log or the roles of its versions may have changed."""
        self._wake(model)

    def revise(self, name: str, version: int, revision: int, learnt: Revision) -> bool:
        """Apply a revision to a version, now or once it is loaded; return whether answers changed.

        Ignore it if an equal or higher revision is present. Fast, but it may wait for a lock: use it in a thread.
        """
        key, learnt = (name, version), self._store(learnt)
        with self._revising:  # one at a time, so that the highest revision wins
            if key in self._snapshot.deleted:
                return False
            known = self._revisions.pop(key, None)
            if known is not None and known[0] >= revision:
                revision, learnt = known
            self._revisions[key] = (revision, learnt)  # moves to the end: the oldest is dropped first
            while len(self._revisions) > 2 * self.capacity:
                del self._revisions[next(iter(self._revisions))]
            known_version = self._snapshot.served.get(key) or self._held.get(key)
            if known_version is None or known_version.revision >= revision:
                return False
            served = replace(known_version, model=warmed(learnt.apply(known_version.base)), revision=revision)
            return self._publish(served) is served

    def scales(self, model: str) -> dict[int, Scales]:
        """Return the width factors of a model's versions, of those that were ever in memory."""
        return self._loader.scales(model)

    def preload(self) -> int:
        """Load the serving versions of the most recently changed models, as many as fit; return how many."""
        gc.freeze()  # keeps imported modules out of collections, which would take 0.3 s longer each
        recent = registry.serving(self.database, registry.recent(self.database, self.capacity))
        return sum(self._adopt(model, serving) for model, serving in recent.items())

    def _load(self, row: VersionRow, serving: Serving | None = None) -> ServedModel:
        key = (row.model, row.version)
        with self._lock:
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:  # a second request for the same version waits for the first, others do not
            served = self._snapshot.served.get(key)
            if served is None:
                served, is_behind = self._loader.load(row, self._revisions.get(key))
                if is_behind:
                    self._wake(row.model)
            served = self._publish(served, serving)
            if (learnt := self._revisions.get(key)) is not None:  # published while this was loaded
                self.revise(*key, *learnt)
                served = self._snapshot.served.get(key, served)
            freeze_version()
            with self._lock:
                self._loading.pop(key, None)
        return served

    def _publish(self, served: ServedModel, serving: Serving | None = None) -> ServedModel:
        """Answer with a version from now on and return the version that answers.

        If `serving` is given, the version also serves its model.
        """
        key = (served.name, served.version)
        with self._lock:
            if key in self._snapshot.deleted:  # deleted while it was loaded: only earlier requests get it
                return served
            if key not in self._used:  # a new revision of a loaded version does not count as use
                self._used[key] = next(self._clock)
            snapshot = self._snapshot.with_version(served)
            current = snapshot.served[key]
            if current is served:
                self._held[key] = served
            if serving is not None:
                self._used[key] = next(self._clock)
                snapshot = snapshot.with_serving(served.name, serving)
            dropped = sorted(snapshot.served, key=lambda each: self._used.get(each, -1))[: -self.capacity]
            for oldest in dropped:
                self._used.pop(oldest, None)
            self._snapshot = snapshot.without(dropped)
        self._report_change((served.name,))
        return current

    def _report_change(self, models: Iterable[str]) -> None:
        """Wake those that wait for a change of these models, and those that publish what answers."""
        for model in models:
            self.waiters.wake(model)
        self.changes.note()
