"""Model versions in memory: what hot routes answer from, without a lock and without the database."""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakValueDictionary

import numpy as np

import lipcore
from lipcore.model import TorqueModel
from lipcore.online.revision import Revision
from service.database import Database, VersionRow
from service.errors import UnreadableVersionError
from service.files import Files
from service.models import registry
from service.models.registry import Serving
from service.updates.learner import learnt as learning

logger = logging.getLogger(__name__)

Key = tuple[str, int]


@dataclass(frozen=True)
class Served:
    """One version in memory, immutable: whoever holds it answers from it whatever is learnt or dropped meanwhile.

    model: what answers; base: the version as trained; datasets: ids of the data sets it was trained on; revision:
    online updates applied to it.
    """

    name: str
    version: int
    model: TorqueModel
    base: TorqueModel
    datasets: frozenset[str]
    revision: int = 0

    @cached_property
    def noise_std(self) -> list[float]:
        """Standard deviation of the measured torque around the function, (n,) N·m, as answers carry it."""
        found: list[float] = self.model.noise_std.tolist()
        return found


@dataclass(frozen=True)
class _Snapshot:
    """What is in memory, and which version of each model answers; replaced as a whole, never changed."""

    served: Mapping[Key, Served] = field(default_factory=dict)
    serving: Mapping[str, Serving] = field(default_factory=dict)


class LoadedModels:
    """Cache of loaded versions; safe to share between threads. The least recently used are dropped beyond `capacity`.

    A version becomes the one that answers once it is in memory and warm, by one assignment: queries in flight keep
    theirs, and none waits. So does a revision of it.
    """

    def __init__(self, database: Database, files: Files, capacity: int) -> None:
        self.database, self.files, self.capacity = database, files, capacity
        self._lagging: set[str] = set()
        self._wake: Callable[[str], None] = self._lagging.add
        self._revisions: dict[Key, tuple[int, Revision]] = {}
        self._held: WeakValueDictionary[Key, Served] = WeakValueDictionary()  # by streams too, after they are dropped
        self._revising = threading.Lock()
        self._snapshot = _Snapshot()
        self._lock = threading.Lock()
        self._loading: dict[Key, threading.Lock] = {}
        self._clock = itertools.count()
        self._used: dict[Key, int] = {}

    def hot(self, model: str, version: int | None) -> Served | None:
        """Return a version, the one that serves where None, if it is in memory; never waits."""
        snapshot = self._snapshot
        if version is None:
            serving = snapshot.serving.get(model)
            if serving is None:
                return None
            version = serving.version
        key = (model, version)
        found = snapshot.served.get(key)
        if found is not None:
            self._used[key] = next(self._clock)
        return found

    def newest(self, model: str) -> int | None:
        """Return the version that answers where none is named, in memory or dropped since; never waits."""
        serving = self._snapshot.serving.get(model)
        return None if serving is None else serving.version

    def get(self, model: str, version: int | None) -> Served:
        """Return a version, the one that serves where None, loaded if need be. Not for the event loop.

        Raise NotFoundError or UnreadableVersionError.
        """
        found = self.hot(model, version)
        if found is not None:
            return found
        if version is None and model in (serving := registry.serving(self.database, [model])):
            return self._load(registry.find(self.database, model, serving[model].version), serving[model])
        return self._load(registry.find(self.database, model, version))

    def announce(self, models: Collection[str]) -> None:
        """Answer for these models with the versions that now serve. Not for the event loop."""
        known = self._snapshot.serving  # a model without an answer yet is loaded when it is asked
        for model, serving in registry.serving(self.database, [each for each in models if each in known]).items():
            if serving.change > known[model].change:
                self.adopt(model)

    def adopt(self, model: str) -> None:
        """Load the version of a model that now serves, and answer with it. Not for the event loop."""
        for serving in registry.serving(self.database, [model]).values():
            try:
                self._load(registry.find(self.database, model, serving.version), serving)
            except UnreadableVersionError as error:  # who asks for it is told; the version before goes on answering
                logger.error("%s", error)

    def learn_from(self, wake: Callable[[str], None]) -> None:
        """Have a learner woken, by the name of the model, whenever a version is loaded without all that its log holds.

        It is woken for those that have been loaded so already.
        """
        self._wake = wake
        while self._lagging:
            wake(self._lagging.pop())

    def revise(self, name: str, version: int, revision: int, learnt: Revision) -> bool:
        """Answer with what a version has learnt, from now on or once it is loaded; return whether that changed answers.

        Nothing is done where a revision as high is known. Not for the event loop; it computes next to nothing.
        """
        key = (name, version)
        with self._revising:  # one at a time, so that the highest is the last
            known = self._revisions.pop(key, None)
            if known is not None and known[0] >= revision:
                revision, learnt = known
            self._revisions[key] = (revision, learnt)  # the last that came is the last to go
            while len(self._revisions) > 2 * self.capacity:
                del self._revisions[next(iter(self._revisions))]
            found = self._snapshot.served.get(key) or self._held.get(key)
            if found is None or found.revision >= revision:
                return False
            served = replace(found, model=_warm(learnt.apply(found.base)), revision=revision)
            return self._publish(served) is served

    def preload(self) -> int:
        """Load the versions that serve of the models that changed last, as many as fit; return how many."""
        gc.freeze()  # what was imported, unexamined: looking through it takes 0.3 s
        loaded = 0
        for model, serving in registry.serving(self.database, registry.recent(self.database, self.capacity)).items():
            try:
                self._load(registry.find(self.database, model, serving.version), serving)
                loaded += 1
            except UnreadableVersionError as error:  # the others shall answer all the same
                logger.error("%s", error)
        return loaded

    def _load(self, row: VersionRow, serving: Serving | None = None) -> Served:
        key = (row.model, row.version)
        with self._lock:
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:  # a second request for the same version waits for the first, others do not
            served = self._snapshot.served.get(key)
            if served is None:
                served = self._make(row)
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
        datasets = frozenset(item["id"] for item in row.manifest["lineage"].get("datasets", []))
        served = Served(row.model, row.version, base, base, datasets)
        if (published := self._revisions.get((row.model, row.version))) is not None:
            revision, learnt = published
            return replace(served, model=_warm(learnt.apply(base)), revision=revision)
        try:
            known = learning.find(self.database, self.files, row.model, row.version, base)
        except Exception:  # whoever asks is answered all the same, by the version as trained, and told its revision
            logger.exception("what version %d of model %r has learnt is not known", row.version, row.model)
            return served
        if known is None:
            return served
        if known.behind:
            self._wake(row.model)
        return replace(served, model=_warm(known.model), revision=known.revision)

    def _read(self, row: VersionRow) -> TorqueModel:
        try:
            return lipcore.load(self.files.versions / row.folder)
        except lipcore.ModelFormatError as error:
            message = f"version {row.version} of model {row.model!r} cannot be loaded: {error}"
            raise UnreadableVersionError(message) from error

    def _publish(self, served: Served, serving: Serving | None = None) -> Served:
        """Answer with a version from now on, and with this one of its model where told; return what answers."""
        key = (served.name, served.version)
        with self._lock:
            self._used.setdefault(key, next(self._clock))
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
        return current


def _warm(model: TorqueModel) -> TorqueModel:
    """The model after an answer, which brings its arrays into memory."""
    model.answer(np.zeros((3, model.n_joints)))
    return model
