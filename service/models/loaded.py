"""Model versions in memory. Hot routes read them without a lock and without the database."""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from weakref import WeakValueDictionary

import numpy as np

import lipcore
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import Revision
from service.contract.states import PartState
from service.foundation.errors import NotFoundError, UnreadableVersionError
from service.foundation.settings import Settings
from service.models import registry
from service.models.lineage import learnt_from
from service.models.loads import StreamPayloads
from service.models.registry import SERVING, Serving
from service.models.scales import Scales
from service.models.served import Alias, Key, LearntStates, RevisionWaiters, ServedModel
from service.storage.database import VersionRow
from service.storage.storage import Storage

logger = logging.getLogger(__name__)

__all__ = ["LoadedModels", "ServedModel"]


PRELOADED: dict[str, TorqueModel] = {}


@dataclass(frozen=True)
class Snapshot:
    """Versions in memory, the serving version of each model, and all other aliases; replaced as a whole."""

    served: Mapping[Key, ServedModel] = field(default_factory=dict)
    serving: Mapping[str, Serving] = field(default_factory=dict)
    aliases: Mapping[Alias, int] = field(default_factory=dict)

    def pointed(self, model: str, alias: str | None) -> int | None:
        """Return the version of an alias, the serving version if `alias` is None.

        Return None if this snapshot does not contain it.
        """
        if alias is None or alias == SERVING:
            serving = self.serving.get(model)
            return None if serving is None else serving.version
        return self.aliases.get((model, alias))

    def without(self, gone: set[Key], model: str | None) -> Snapshot:
        """Return a copy without some versions and, if `model` is given, without that model's aliases."""
        return Snapshot(
            {key: each for key, each in self.served.items() if key not in gone},
            {name: each for name, each in self.serving.items() if name != model},
            {key: each for key, each in self.aliases.items() if key[0] != model},
        )


class LoadedModels:
    """Cache of loaded versions; safe to share between threads.

    Beyond `capacity`, a setting, the least recently used versions are dropped. A version starts to answer once it is in
    memory and warm, by one assignment. Queries in flight keep theirs, and none waits. Revisions and aliases change in
    the same way.
    """

    def __init__(self, storage: Storage, learnt: LearntStates, capacity: int | None = None) -> None:
        self.storage, self.learnt = storage, learnt
        self.database, self.files = storage.database, storage.files
        self.capacity = storage.settings.max_loaded_models if capacity is None else capacity
        self.preloaded: Mapping[str, TorqueModel] = PRELOADED
        """Versions that were loaded before this process was forked, by folder."""
        self.when_deleted: list[Callable[[str], None]] = []
        """Functions called with the name of a deleted model."""
        self._lagging: set[str] = set()
        self._wake: Callable[[str], None] = self._lagging.add
        self._revisions: dict[Key, tuple[int, Revision]] = {}
        self._held: WeakValueDictionary[Key, ServedModel] = WeakValueDictionary()  # streams keep dropped versions
        self._revising = threading.Lock()
        self._snapshot = Snapshot(aliases=registry.pointers(storage.database))
        self._deleted: set[Key] = set()
        self._lock = threading.Lock()
        self.moving = threading.Lock()
        """Lock for moves of aliases and deletions of versions. Its holder changes the database, then this object."""
        self.waiters = RevisionWaiters()
        """Queries that wait for a revision."""
        self._loading: dict[Key, threading.Lock] = {}
        self._clock = itertools.count()
        self._used: dict[Key, int] = {}
        self._unreadable: dict[Key, str] = {}
        self._scales: dict[Key, Scales] = {}
        self._payloads: dict[Key, StreamPayloads] = {}

    @property
    def settings(self) -> Settings:
        """The settings of the service."""
        return self.storage.settings

    def hot(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version, or the version of an alias, if it is in memory; never waits.

        Without a version and an alias, or with the alias `serving`, return the serving version.
        """
        snapshot = self._snapshot
        if version is None:
            version = snapshot.pointed(model, alias)
            if version is None:
                return None
        key = (model, version)
        served = snapshot.served.get(key)
        if served is not None:
            self._used[key] = next(self._clock)
        return served

    def peek(self, model: str) -> ServedModel | None:
        """Return the serving version if it is in memory; never waits. The call does not count as use."""
        snapshot = self._snapshot
        serving = snapshot.serving.get(model)
        return None if serving is None else snapshot.served.get((model, serving.version))

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the number of the version of an alias, or of the serving version, even if dropped; never waits."""
        return self._snapshot.pointed(model, alias)

    def is_deleted(self, model: str, version: int) -> bool:
        """Return whether a version was deleted since the service started; never waits."""
        return (model, version) in self._deleted

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
            aliases = {**self._snapshot.aliases}
            aliases.pop((model, alias), None)
            if version is not None:
                aliases[model, alias] = version
            self._snapshot = replace(self._snapshot, aliases=aliases)
        self.waiters.wake(model)

    def aliases(self) -> Mapping[Alias, int]:
        """Return the version of every alias except `serving`."""
        return self._snapshot.aliases

    def repoint(self, aliases: Mapping[Alias, int], models: Collection[str] | None) -> None:
        """Replace the aliases of these models, of all models if None.

        The caller holds `moving` and has changed the database.
        """
        with self._lock:
            kept = {} if models is None else {k: v for k, v in self._snapshot.aliases.items() if k[0] not in models}
            self._snapshot = replace(self._snapshot, aliases=kept | dict(aliases))
        for model in {model for model, _ in aliases}:
            self.waiters.wake(model)

    def forget(self, model: str, versions: Collection[int], entirely: bool = False) -> None:
        """Stop answering with deleted versions; the caller holds `moving`.

        `entirely`: the model was deleted too. Queries in flight keep their version. Call this before the files are
        removed, so that a reader that finds no file finds the reason here.
        """
        gone = {(model, version) for version in versions}
        with self._revising, self._lock:
            self._deleted |= gone
            self._snapshot = self._snapshot.without(gone, model if entirely else None)
            for key in gone:
                self._revisions.pop(key, None)
                self._held.pop(key, None)
                self._used.pop(key, None)
                self._unreadable.pop(key, None)
                self._scales.pop(key, None)
                self._payloads.pop(key, None)
        self.waiters.wake(model)
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
        """Load a version that serves; return whether that succeeded."""
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
        return dict(self._unreadable)

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
        key = (name, version)
        with self._revising:  # one at a time, so that the highest revision wins
            if key in self._deleted:
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
            served = replace(known_version, model=_warm(learnt.apply(known_version.base)), revision=revision)
            return self._publish(served) is served

    def scales(self, model: str) -> dict[int, Scales]:
        """Return the width factors of a model's versions, of those that were ever in memory."""
        with self._lock:
            return {version: scales for (name, version), scales in self._scales.items() if name == model}

    def served(self, model: str) -> dict[int, ServedModel]:
        """Return a model's versions that are in memory."""
        return {version: each for (name, version), each in self._snapshot.served.items() if name == model}

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
                try:
                    served = self._make(row)
                except UnreadableVersionError as error:
                    self._unreadable[key] = str(error)
                    raise
                self._unreadable.pop(key, None)
            served = self._publish(served, serving)
            if (learnt := self._revisions.get(key)) is not None:  # published while this was loaded
                self.revise(*key, *learnt)
                served = self._snapshot.served.get(key, served)
            # later garbage collections skip frozen objects: a scan of the version would stop all answers. A dropped
            # version is still freed, because a model is in no reference cycle. Only a few hundred objects of current
            # requests are frozen with it
            gc.collect()
            gc.freeze()
            with self._lock:
                self._loading.pop(key, None)
        return served

    def _make(self, row: VersionRow) -> ServedModel:
        base = self._read(row)
        base.warm_up()
        scales = self._scales_of(row, base.scale)
        with self._lock:
            payloads = self._payloads.setdefault((row.model, row.version), StreamPayloads())
        served = ServedModel(row.model, row.version, base, base, learnt_from(row.manifest["lineage"]), scales, payloads)
        if served.carrier is not None and payloads.fresh:
            served.carrier.warm_up()
            payloads.replace(self.learnt.payloads(row.model, row.version, served.carrier))
        if (published := self._revisions.get((row.model, row.version))) is not None:
            revision, learnt = published
            return replace(served, model=_warm(learnt.apply(base)), revision=revision)
        try:
            known = self.learnt.find(row.model, row.version, base)
        except Exception:  # queries are answered by the version as trained; the reply states its revision
            logger.exception(
                "could not read what version %d of model %r has learnt; serving it as trained",
                row.version,
                row.model,
            )
            return served
        if known is None:
            return served
        if known.behind:
            self._wake(row.model)
        return replace(served, model=_warm(known.model), revision=known.revision)

    def _scales_of(self, row: VersionRow, own: Array) -> Scales:
        """Return the version's width factors as of its last use, or as of the last run of the service."""
        key = (row.model, row.version)
        if (known := self._scales.get(key)) is not None:
            return known
        scales = Scales(own)
        scales.replace(self.learnt.factors(*key))
        with self._lock:
            return self._scales.setdefault(key, scales)

    def _read(self, row: VersionRow) -> TorqueModel:
        try:
            return self.preloaded.get(row.folder) or self.files.load_version(row.folder, row.checksums)
        except lipcore.ModelFormatError as error:
            registry.find(self.database, row.model, row.version)  # it may have been deleted meanwhile
            message = f"version {row.version} of model {row.model!r} cannot be loaded: {error}"
            raise UnreadableVersionError(message) from error

    def _publish(self, served: ServedModel, serving: Serving | None = None) -> ServedModel:
        """Answer with a version from now on and return the version that answers.

        If `serving` is given, the version also serves its model.
        """
        key = (served.name, served.version)
        with self._lock:
            if key in self._deleted:  # deleted while it was loaded: only earlier requests get it
                return served
            if key not in self._used:  # a new revision of a loaded version does not count as use
                self._used[key] = next(self._clock)
            entries, pointers = dict(self._snapshot.served), dict(self._snapshot.serving)
            current = entries.get(key)
            if current is None or current.revision < served.revision:
                entries[key] = self._held[key] = current = served
            if serving is not None:
                self._used[key] = next(self._clock)
                known = pointers.get(served.name)
                pointers[served.name] = serving if known is None or serving.change > known.change else known
            while len(entries) > self.capacity:
                oldest = min(entries, key=lambda each: self._used.get(each, -1))
                del entries[oldest]
                self._used.pop(oldest, None)
            self._snapshot = replace(self._snapshot, served=entries, serving=pointers)
        self.waiters.wake(served.name)
        return current


def _warm(model: TorqueModel) -> TorqueModel:
    """Return the model after one prediction, which loads its arrays into memory."""
    model.answer(np.zeros((3, model.n_joints)))
    return model
