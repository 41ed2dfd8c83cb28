"""Model versions in memory: what hot routes answer from, without a lock and without the database."""

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
from service.models import registry
from service.models.lineage import learnt_from
from service.models.loads import Loads
from service.models.registry import SERVING, Serving
from service.models.scales import Scales
from service.models.served import Alias, Key, LearntStates, Served, Waiting
from service.storage.database import VersionRow
from service.storage.storage import Storage

logger = logging.getLogger(__name__)

__all__ = ["LoadedModels", "Served"]


@dataclass(frozen=True)
class Snapshot:
    """What is in memory, which version of each model answers, and where all aliases point; replaced as a whole."""

    served: Mapping[Key, Served] = field(default_factory=dict)
    serving: Mapping[str, Serving] = field(default_factory=dict)
    aliases: Mapping[Alias, int] = field(default_factory=dict)

    def pointed(self, model: str, alias: str | None) -> int | None:
        """The version that an alias points to, or that serves where it is None; None where that is not known."""
        if alias is None or alias == SERVING:
            serving = self.serving.get(model)
            return None if serving is None else serving.version
        return self.aliases.get((model, alias))

    def without(self, gone: set[Key], model: str | None) -> Snapshot:
        """The same without some versions and, where given, without a model's pointers."""
        return Snapshot(
            {key: each for key, each in self.served.items() if key not in gone},
            {name: each for name, each in self.serving.items() if name != model},
            {key: each for key, each in self.aliases.items() if key[0] != model},
        )


class LoadedModels:
    """Cache of loaded versions; safe to share between threads. The least recently used are dropped beyond `capacity`, a
    setting.

    A version becomes the one that answers once it is in memory and warm, by one assignment: queries in flight keep
    theirs, and none waits. So does a revision of it. An alias moves in the same way.

    learnt: knows what versions have learnt. moving: held while an alias is moved or a version deleted, in the database
    and then here, one at a time. waiting: who waits for a model to answer otherwise. when_deleted: called with the name
    of a model that is gone.
    """

    def __init__(self, storage: Storage, learnt: LearntStates, capacity: int | None = None) -> None:
        self.storage, self.learnt = storage, learnt
        self.database, self.files = storage.database, storage.files
        self.capacity = storage.settings.max_loaded_models if capacity is None else capacity
        self.when_deleted: list[Callable[[str], None]] = []
        self._lagging: set[str] = set()
        self._wake: Callable[[str], None] = self._lagging.add
        self._revisions: dict[Key, tuple[int, Revision]] = {}
        self._held: WeakValueDictionary[Key, Served] = WeakValueDictionary()  # by streams too, after they are dropped
        self._revising = threading.Lock()
        self._snapshot = Snapshot(aliases=registry.pointers(storage.database))
        self._deleted: set[Key] = set()
        self._lock = threading.Lock()
        self.moving = threading.Lock()
        self.waiting = Waiting()
        self._loading: dict[Key, threading.Lock] = {}
        self._clock = itertools.count()
        self._used: dict[Key, int] = {}
        self._unreadable: dict[Key, str] = {}
        self._scales: dict[Key, Scales] = {}
        self._loads: dict[Key, Loads] = {}

    def hot(self, model: str, version: int | None, alias: str | None = None) -> Served | None:
        """Return a version, or the one that an alias points to, if it is in memory; never waits. With neither, as with
        the alias `serving`, it is the one that serves."""
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

    def peek(self, model: str) -> Served | None:
        """Return the version that serves if it is in memory; never waits. Asking does not count as using it."""
        snapshot = self._snapshot
        serving = snapshot.serving.get(model)
        return None if serving is None else snapshot.served.get((model, serving.version))

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the version that answers where an alias is named, or none, in memory or dropped since; never waits."""
        return self._snapshot.pointed(model, alias)

    def is_deleted(self, model: str, version: int) -> bool:
        """Whether a version has been deleted since the service started; never waits."""
        return (model, version) in self._deleted

    def get(self, model: str, version: int | None, alias: str | None = None) -> Served:
        """Return a version, or the one that an alias points to, loaded if need be. Not for the event loop. With neither
        it is the one that serves. Raise NotFoundError or UnreadableVersionError."""
        served = self.hot(model, version, alias)
        while served is None:
            number, serving = self.meant(model, version, alias)
            try:
                served = self._load(registry.find(self.database, model, number), serving)
            except NotFoundError:
                if self.meant(model, version, alias)[0] == number:
                    raise  # else the alias has moved on, and the version before was deleted
        return served

    def meant(self, model: str, version: int | None, alias: str | None) -> tuple[int | None, Serving | None]:
        """The number of the version that is meant, and what serves where that is it; raise NotFoundError."""
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
        """Let an alias point to a version from now on, or to none; `moving` is held, and the database says so."""
        with self._lock:
            aliases = {**self._snapshot.aliases}
            aliases.pop((model, alias), None)
            if version is not None:
                aliases[model, alias] = version
            self._snapshot = replace(self._snapshot, aliases=aliases)
        self.waiting.wake(model)

    def aliases(self) -> Mapping[Alias, int]:
        """Where every alias points that has been given, but for those that serve."""
        return self._snapshot.aliases

    def repoint(self, aliases: Mapping[Alias, int], models: Collection[str] | None) -> None:
        """Let the aliases of these models, of all where None, be these; `moving` is held, and the database says so."""
        with self._lock:
            kept = {} if models is None else {k: v for k, v in self._snapshot.aliases.items() if k[0] not in models}
            self._snapshot = replace(self._snapshot, aliases=kept | dict(aliases))
        for model in {model for model, _ in aliases}:
            self.waiting.wake(model)

    def forget(self, model: str, versions: Collection[int], entirely: bool = False) -> None:
        """Answer no more with these versions, which have been deleted; `moving` is held.

        entirely: the model has been deleted with them. Queries in flight keep theirs. To be called before their files
        go: who finds them gone has to know why.
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
                self._loads.pop(key, None)
        self.waiting.wake(model)
        if entirely:
            for deleted in self.when_deleted:
                deleted(model)

    def announce(self, models: Collection[str]) -> None:
        """Answer for these models with the versions that now serve. Not for the event loop."""
        known = self._snapshot.serving  # a model without an answer yet is loaded when it is asked
        for model, serving in registry.serving(self.database, [each for each in models if each in known]).items():
            if serving.change > known[model].change:
                self.adopt(model)

    def changed(self, model: str) -> None:
        """Answer with what a job has changed of a model: the version that serves, and where its aliases point. Not for
        the event loop."""
        with self.moving:
            self.repoint(registry.pointers(self.database, [model]), [model])
        self.adopt(model)

    def adopt(self, model: str) -> None:
        """Load the version of a model that now serves, and answer with it. Not for the event loop."""
        for serving in registry.serving(self.database, [model]).values():
            self._adopt(model, serving)

    def _adopt(self, model: str, serving: Serving) -> bool:
        """Load a version that serves; return whether it could be."""
        try:
            self._load(registry.find(self.database, model, serving.version), serving)
            return True
        except (UnreadableVersionError, OSError) as error:  # who asks is told; the version before goes on answering
            logger.error("%s", error)
        except NotFoundError:  # another one serves by now, and this one has been deleted: who did that adopts it
            logger.info("version %d of model %s was deleted before it answered", serving.version, model)
        return False

    def held(self) -> dict[Key, int | None]:
        """Versions that anyone here may answer with, and their revisions: those in memory, of streams too, and those
        that serve, which may have been dropped (None)."""
        snapshot = self._snapshot
        revisions: dict[Key, int | None] = {(model, each.version): None for model, each in snapshot.serving.items()}
        streamed = [each for ref in self._held.valuerefs() if (each := ref()) is not None]
        return revisions | {(each.name, each.version): each.revision for each in (*streamed, *snapshot.served.values())}

    def versions(self) -> Collection[Key]:
        """Versions that are in memory; asking does not count as using them."""
        return self._snapshot.served.keys()

    def look(self, lasting: object = None) -> tuple[PartState, str]:
        """Whether the versions that serve can be read, for readiness."""
        lost, models = registry.lost(self.database, self.files, self.versions(), self.unreadable())
        if not lost:
            return "ok", f"{models} can be read"
        state: PartState = "failed" if lost == models else "warning"
        return state, f"{lost} of {models} cannot be read: `lipserve verify` names them"

    def unreadable(self) -> dict[Key, str]:
        """Versions that could not be read when they were last asked for, and why."""
        return dict(self._unreadable)

    def learn_from(self, wake: Callable[[str], None]) -> None:
        """Have a learner woken, by the name of the model, whenever a version is loaded without all that its log holds.
        It is woken for those that have been loaded so already."""
        self._wake = wake
        while self._lagging:
            wake(self._lagging.pop())

    def wake(self, model: str) -> None:
        """Have the learner look at a model: its log, or the roles of its versions, may have changed."""
        self._wake(model)

    def revise(self, name: str, version: int, revision: int, learnt: Revision) -> bool:
        """Answer with what a version has learnt, from now on or once it is loaded; return whether that changed answers.
        Nothing is done where a revision as high is known. Not for the event loop; it computes next to nothing."""
        key = (name, version)
        with self._revising:  # one at a time, so that the highest is the last
            if key in self._deleted:
                return False
            known = self._revisions.pop(key, None)
            if known is not None and known[0] >= revision:
                revision, learnt = known
            self._revisions[key] = (revision, learnt)  # the last that came is the last to go
            while len(self._revisions) > 2 * self.capacity:
                del self._revisions[next(iter(self._revisions))]
            known_version = self._snapshot.served.get(key) or self._held.get(key)
            if known_version is None or known_version.revision >= revision:
                return False
            served = replace(known_version, model=_warm(learnt.apply(known_version.base)), revision=revision)
            return self._publish(served) is served

    def scales(self, model: str) -> dict[int, Scales]:
        """The widths of the intervals of a model's versions, of those that have been in memory."""
        with self._lock:
            return {version: scales for (name, version), scales in self._scales.items() if name == model}

    def served(self, model: str) -> dict[int, Served]:
        """A model's versions that are in memory."""
        return {version: each for (name, version), each in self._snapshot.served.items() if name == model}

    def preload(self) -> int:
        """Load the versions that serve of the models that changed last, as many as fit; return how many."""
        gc.freeze()  # what was imported, unexamined: looking through it takes 0.3 s
        recent = registry.serving(self.database, registry.recent(self.database, self.capacity))
        return sum(self._adopt(model, serving) for model, serving in recent.items())

    def _load(self, row: VersionRow, serving: Serving | None = None) -> Served:
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
            # keeps the version out of collections, which would stop every answer for as long as they look through it.
            # What is dropped later is freed all the same: a model is in no cycle. Nothing else is frozen but a few
            # hundred objects of requests under way
            gc.collect()
            gc.freeze()
            with self._lock:
                self._loading.pop(key, None)
        return served

    def _make(self, row: VersionRow) -> Served:
        base = self._read(row)
        base.warm_up()
        scales = self._scales_of(row, base.scale)
        with self._lock:
            loads = self._loads.setdefault((row.model, row.version), Loads())
        served = Served(row.model, row.version, base, base, learnt_from(row.manifest["lineage"]), scales, loads)
        if served.carrier is not None and loads.fresh:
            served.carrier.warm_up()
            loads.take(self.learnt.carried(row.model, row.version, served.carrier))
        if (published := self._revisions.get((row.model, row.version))) is not None:
            revision, learnt = published
            return replace(served, model=_warm(learnt.apply(base)), revision=revision)
        try:
            known = self.learnt.find(row.model, row.version, base)
        except Exception:  # whoever asks is answered all the same, by the version as trained, and told its revision
            logger.exception("what version %d of model %r has learnt is not known", row.version, row.model)
            return served
        if known is None:
            return served
        if known.behind:
            self._wake(row.model)
        return replace(served, model=_warm(known.model), revision=known.revision)

    def _scales_of(self, row: VersionRow, own: Array) -> Scales:
        """The widths that a version's streams had come to when it was last in memory, or the service last ran."""
        key = (row.model, row.version)
        if (known := self._scales.get(key)) is not None:
            return known
        scales = Scales(own)
        scales.take(self.learnt.factors(*key))
        with self._lock:
            return self._scales.setdefault(key, scales)

    def _read(self, row: VersionRow) -> TorqueModel:
        try:
            return self.files.load_version(row.folder, row.checksums)
        except lipcore.ModelFormatError as error:
            registry.find(self.database, row.model, row.version)  # it may have been deleted meanwhile
            message = f"version {row.version} of model {row.model!r} cannot be loaded: {error}"
            raise UnreadableVersionError(message) from error

    def _publish(self, served: Served, serving: Serving | None = None) -> Served:
        """Answer with a version from now on, and with this one of its model where told; return what answers."""
        key = (served.name, served.version)
        with self._lock:
            if key in self._deleted:  # while it was loaded: who asked before is answered, nobody after
                return served
            if key not in self._used:  # a revision of one that is known is no use of it
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
        self.waiting.wake(served.name)
        return current


def _warm(model: TorqueModel) -> TorqueModel:
    """The model after an answer, which brings its arrays into memory."""
    model.answer(np.zeros((3, model.n_joints)))
    return model
