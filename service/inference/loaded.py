"""Model versions in memory: what hot routes answer from, without a lock and without the database."""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import lipcore
from lipcore.model import TorqueModel
from service.database import Database, VersionRow
from service.errors import UnreadableVersionError
from service.files import Files
from service.models import registry

logger = logging.getLogger(__name__)

Key = tuple[str, int]


@dataclass(frozen=True)
class Served:
    """One version in memory, immutable: whoever holds it answers from it whatever is trained or dropped meanwhile.

    revision: online updates applied to it; datasets: ids of the data sets it was trained on.
    """

    name: str
    version: int
    model: TorqueModel
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
    latest: Mapping[str, int] = field(default_factory=dict)


class LoadedModels:
    """Cache of loaded versions; safe to share between threads. The least recently used are dropped beyond `capacity`.

    A version becomes the one that answers once it is in memory and warm, by one assignment: queries in flight keep
    theirs, and none waits.
    """

    def __init__(self, database: Database, files: Files, capacity: int) -> None:
        self.database, self.files, self.capacity = database, files, capacity
        self._snapshot = _Snapshot()
        self._lock = threading.Lock()
        self._loading: dict[Key, threading.Lock] = {}
        self._clock = itertools.count()
        self._used: dict[Key, int] = {}

    def hot(self, model: str, version: int | None) -> Served | None:
        """Return a version, the latest where None, if it is in memory; never waits."""
        snapshot = self._snapshot
        number = snapshot.latest.get(model) if version is None else version
        if number is None:
            return None
        key = (model, number)
        found = snapshot.served.get(key)
        if found is not None:
            self._used[key] = next(self._clock)
        return found

    def newest(self, model: str) -> int | None:
        """Return the version that answers where none is named, in memory or dropped since; never waits."""
        return self._snapshot.latest.get(model)

    def get(self, model: str, version: int | None) -> Served:
        """Return a version, the latest where None, loaded if need be. Not for the event loop.

        Raise NotFoundError or UnreadableVersionError.
        """
        return self.hot(model, version) or self._load(registry.find(self.database, model, version), version is None)

    def announce(self, model: str, version: int) -> None:
        """Never again answer with an older version than this one. Not for the event loop."""
        known = self._snapshot.latest.get(model)
        if known is not None and version > known:  # a model without an answer yet is loaded when it is asked
            self.adopt(model, version)

    def adopt(self, model: str, version: int) -> None:
        """Load a new version, and answer with it if it is the newest. Not for the event loop."""
        try:
            self._load(registry.find(self.database, model, version), latest=True)
        except UnreadableVersionError as error:  # who asks for it is told; the version before goes on answering
            logger.error("%s", error)

    def preload(self) -> int:
        """Load the latest versions of the models that changed last, as many as fit; return how many."""
        gc.freeze()  # what was imported, unexamined: looking through it takes 0.3 s
        loaded = 0
        for row in registry.recent(self.database, self.capacity):
            try:
                self._load(row, latest=True)
                loaded += 1
            except UnreadableVersionError as error:  # the others shall answer all the same
                logger.error("%s", error)
        return loaded

    def _load(self, row: VersionRow, latest: bool) -> Served:
        key = (row.model, row.version)
        with self._lock:
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:  # a second request for the same version waits for the first, others do not
            served = self._snapshot.served.get(key)
            if served is None:
                model = self._read(row)
                model.warm_up()
                datasets = frozenset(item["id"] for item in row.manifest["lineage"].get("datasets", []))
                served = Served(row.model, row.version, model, datasets)
            self._publish(served, latest)
            # keeps the version out of collections, which would stop every answer for as long as they look through it.
            # What is dropped later is freed all the same: a model is in no cycle. Nothing else is frozen but a few
            # hundred objects of requests under way
            gc.collect()
            gc.freeze()
            with self._lock:
                self._loading.pop(key, None)
        return served

    def _read(self, row: VersionRow) -> TorqueModel:
        try:
            return lipcore.load(self.files.versions / row.folder)
        except lipcore.ModelFormatError as error:
            message = f"version {row.version} of model {row.model!r} cannot be loaded: {error}"
            raise UnreadableVersionError(message) from error

    def _publish(self, served: Served, latest: bool) -> None:
        key = (served.name, served.version)
        with self._lock:
            self._used[key] = next(self._clock)
            entries, newest = {**self._snapshot.served, key: served}, dict(self._snapshot.latest)
            if latest:
                newest[served.name] = max(served.version, newest.get(served.name, 0))
            while len(entries) > self.capacity:
                oldest = min(entries, key=lambda each: self._used.get(each, -1))
                del entries[oldest]
                self._used.pop(oldest, None)
            self._snapshot = replace(self._snapshot, served=entries, latest=newest)
