"""Versions read from files, with what they have learnt, their width factors and payloads."""

from __future__ import annotations

import gc
import logging
import threading
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np

import lipcore
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.transfer import Revision
from service.foundation.errors import UnreadableVersionError
from service.models import registry
from service.models.lineage import learnt_from
from service.models.loads import StreamPayloads
from service.models.scales import Scales
from service.models.served import Key, LearntStates, ServedModel
from service.storage.database import Database, VersionRow
from service.storage.files import Files

logger = logging.getLogger(__name__)

Store = Callable[[Any], Any]
"""Returns an equal object whose arrays are elsewhere in memory."""
PRELOADED: dict[str, TorqueModel] = {}
"""Versions that were loaded before this process was forked, by folder."""


class VersionLoader:
    """Reads versions; safe to share between threads.

    It keeps the width factors and the payloads of each version that was ever in memory, and why versions cannot be
    read. changed: called after a change of width factors or payloads. store: see `LoadedModels`.
    """

    def __init__(
        self, database: Database, files: Files, learnt: LearntStates, changed: Callable[[], None], store: Store
    ) -> None:
        self._database, self._files, self._learnt, self._changed = database, files, learnt, changed
        self._store = store
        self._lock = threading.Lock()
        self._scales: dict[Key, Scales] = {}
        self._payloads: dict[Key, StreamPayloads] = {}
        self._unreadable: dict[Key, str] = {}

    def load(self, row: VersionRow, published: tuple[int, Revision] | None) -> tuple[ServedModel, bool]:
        """Return a version, and whether it lags behind its log. Raise UnreadableVersionError.

        published: the number and the arrays of a revision that the learner has published, if any.
        """
        key = (row.model, row.version)
        try:
            base = self._read(row)
        except UnreadableVersionError as error:
            self._unreadable[key] = str(error)
            raise
        self._unreadable.pop(key, None)
        base.warm_up()
        scales = self._scales_of(key, base.scale)
        with self._lock:
            payloads = self._payloads.setdefault(key, StreamPayloads(self._changed))
        served = ServedModel(*key, base, base, learnt_from(row.manifest["lineage"]), scales, payloads)
        if served.carrier is not None and payloads.fresh:
            served.carrier.warm_up()
            payloads.replace(self._learnt.payloads(*key, served.carrier))
        if published is not None:
            revision, learnt = published
            return replace(served, model=warmed(learnt.apply(base)), revision=revision), False
        try:
            known = self._learnt.find(*key, base)
        except Exception:  # queries are answered by the version as trained; the reply states its revision
            logger.exception(
                "could not read what version %d of model %r has learnt; serving it as trained", row.version, row.model
            )
            return served, False
        if known is None:
            return served, False
        return replace(served, model=warmed(self._store(known.model)), revision=known.revision), known.behind

    def scales(self, model: str) -> dict[int, Scales]:
        """Return the width factors of a model's versions, of those that were ever in memory."""
        with self._lock:
            return {version: scales for (name, version), scales in self._scales.items() if name == model}

    def unreadable(self) -> dict[Key, str]:
        """Return the versions that failed to load at their last use, and why."""
        return dict(self._unreadable)

    def forget(self, keys: Collection[Key]) -> None:
        """Forget deleted versions."""
        with self._lock:
            for key in keys:
                self._scales.pop(key, None)
                self._payloads.pop(key, None)
                self._unreadable.pop(key, None)

    def _scales_of(self, key: Key, own: Array) -> Scales:
        """Return the version's width factors as of its last use, or as of the last run of the service."""
        if (known := self._scales.get(key)) is not None:
            return known
        scales = Scales(own, self._changed)
        scales.replace(self._learnt.factors(*key))
        with self._lock:
            return self._scales.setdefault(key, scales)

    def _read(self, row: VersionRow) -> TorqueModel:
        try:
            if (preloaded := PRELOADED.get(row.folder)) is not None:
                return preloaded
            model = self._files.load_version(row.folder, row.checksums)
            model.warm_up()  # stores what it has built, too
            stored: TorqueModel = self._store(model)
            return stored
        except lipcore.ModelFormatError as error:
            registry.find(self._database, row.model, row.version)  # it may have been deleted meanwhile
            message = f"version {row.version} of model {row.model!r} cannot be loaded: {error}"
            raise UnreadableVersionError(message) from error


def warmed(model: TorqueModel) -> TorqueModel:
    """Return the model after one prediction, which loads its arrays into memory."""
    model.answer(np.zeros((3, model.n_joints)))
    return model


def freeze_version() -> None:
    """Keep a version that was loaded from later garbage collections, whose scan of it would stop all answers.

    A dropped version is still freed, because a model is in no reference cycle. Only a few hundred objects of current
    requests are frozen with it.
    """
    gc.collect()
    gc.freeze()
