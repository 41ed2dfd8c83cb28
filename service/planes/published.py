"""The versions of the data plane: what the control plane has published, without a database."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lipcore.model.payload import PayloadPosterior
from service.foundation.errors import NotReadyError
from service.foundation.settings import Settings
from service.models.loaded import PRELOADED
from service.models.loads import StreamPayload, StreamPayloads
from service.models.registry import SERVING
from service.models.scales import Scales
from service.models.served import Alias, Key, RevisionWaiters, ServedModel
from service.planes.publications import NewRevision, Pointers, StreamState, Version
from service.storage.files import Files


@dataclass(frozen=True)
class Snapshot:
    """What answers now; replaced as a whole."""

    served: Mapping[Key, ServedModel] = field(default_factory=dict)
    serving: Mapping[str, int] = field(default_factory=dict)
    aliases: Mapping[Alias, int] = field(default_factory=dict)
    deleted: frozenset[Key] = frozenset()


class PublishedModels:
    """Stands in for `LoadedModels` in the data plane. One thread applies publications, the event loop reads.

    request: asks the control plane to load a version; it returns whether that is under way.
    """

    def __init__(self, settings: Settings, request: Callable[[str, int | None, str | None], None]) -> None:
        self.settings = settings
        self.waiters = RevisionWaiters()
        self._files, self._request = Files.of(settings), request
        self._snapshot = Snapshot()
        self._changed = threading.Condition()

    def hot(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version if it is in memory; never waits."""
        number = self.newest(model, alias) if version is None else version
        return None if number is None else self._snapshot.served.get((model, number))

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the number of the version of an alias, or of the serving version."""
        snapshot = self._snapshot
        return snapshot.serving.get(model) if alias in (None, SERVING) else snapshot.aliases.get((model, alias))

    def is_deleted(self, model: str, version: int) -> bool:
        """Return whether a version was deleted."""
        return (model, version) in self._snapshot.deleted

    def get(self, model: str, version: int | None, alias: str | None = None) -> ServedModel:
        """Return a version, after the control plane has published it. Raise NotReadyError if it does not.

        Blocking: use it in a thread.
        """
        served = self.hot(model, version, alias)
        if served is None:
            self._request(model, version, alias)
            with self._changed:
                self._changed.wait_for(lambda: self.hot(model, version, alias) is not None, 5.0)
            served = self.hot(model, version, alias)
        if served is None:
            raise NotReadyError(f"Model {model} is not loaded.")
        return served

    def held(self) -> list[str]:
        """Return the models that answer, for a control plane that has just started."""
        return list(self._snapshot.serving)

    def wake(self, model: str) -> None:
        """Do nothing: the control plane wakes the learner."""

    def apply(self, message: Any) -> None:
        """Apply a publication; it takes milliseconds of a thread for a new version or payload."""
        old = self._snapshot
        match message:
            case Version(key) if key not in old.served:
                base = PRELOADED.get(message.folder) or self._files.load_version(message.folder, message.checksums)
                base.warm_up()
                made = ServedModel(*key, base, base, frozenset(), Scales(message.scale), StreamPayloads())
                self._replace(replace(old, served={**old.served, key: made}))
                gc.collect()
                gc.freeze()
            case NewRevision(key, number, arrays) if key in old.served and old.served[key].revision < number:
                model = arrays.apply(old.served[key].base)
                model.answer(np.zeros((3, model.n_joints)))
                made = replace(old.served[key], model=model, revision=number)
                self._replace(replace(old, served={**old.served, key: made}))
            case Pointers(serving, aliases, dropped, deleted):
                served = {key: each for key, each in old.served.items() if key not in dropped | deleted}
                # a control plane that has just started knows fewer models: only deletions take any away
                kept = {model: number for model, number in old.serving.items() if (model, number) not in deleted}
                self._replace(Snapshot(served, kept | serving, aliases, deleted))
            case StreamState(key, factors, payloads) if key in old.served:
                served_model = old.served[key]
                if factors is not None:
                    served_model.scales.replace(factors)
                if payloads is not None:
                    served_model.payloads.replace(
                        {name: _with_model(served_model, *each) for name, each in payloads.items()}
                    )

    def _replace(self, snapshot: Snapshot) -> None:
        models = {model for model, _ in snapshot.served}
        with self._changed:
            self._snapshot = snapshot
            self._changed.notify_all()
        for model in models:
            self.waiters.wake(model)


def _with_model(served: ServedModel, load: PayloadPosterior | None, known: StreamPayload) -> StreamPayload:
    if load is None or served.carrier is None:
        return known
    model = served.carrier.with_payload(load)
    model.answer(np.zeros((3, model.n_joints)))
    return replace(known, model=model)
