"""The versions of the data plane: what the control plane has published, without files and database."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future
from dataclasses import replace
from typing import Any
from weakref import WeakValueDictionary

from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import NotReadyError
from service.foundation.settings import Settings
from service.models.loading import freeze_version, warmed
from service.models.loads import StreamPayload, StreamPayloads
from service.models.registry import Serving
from service.models.scales import Scales
from service.models.served import Key, RevisionWaiters, ServedModel
from service.models.snapshot import Snapshot
from service.planes.publications import (
    Answering,
    Confirmed,
    Holdings,
    LearnerWake,
    LoadRequest,
    NewPayload,
    NewRevision,
    NewVersion,
    NotLoaded,
    PayloadState,
    Pointers,
    Published,
    StreamStates,
    VersionUse,
)

MAX_LOAD_S = 5.0
"""Max seconds that a query waits until the control plane has loaded a version."""


class PublishedModels:
    """Stands in for `LoadedModels` in the data plane. One thread applies publications, the event loop reads.

    Publications merge: a control plane that has just started knows fewer versions. send: sends a message to the control
    plane without waiting and returns whether it was sent.
    """

    def __init__(self, settings: Settings, send: Callable[[Any], bool]) -> None:
        self.settings, self.waiters, self._send = settings, RevisionWaiters(), send
        self.ready = threading.Event()
        """Set after the first complete publication."""
        self._snapshot, self._answers, self._confirmed = Snapshot(), False, -1
        self._held: WeakValueDictionary[Key, ServedModel] = WeakValueDictionary()  # streams keep dropped versions
        self._with_payload: dict[Key, dict[int, TorqueModel]] = {}
        self._used: dict[Key, None] = {}
        self._streamed = frozenset[Key]()
        self._requests: dict[LoadRequest, Future[None]] = {}
        self._lock = threading.Lock()

    def hot(self, model: str, version: int | None, alias: str | None = None) -> ServedModel | None:
        """Return a version if it is in memory; never waits."""
        served = self._snapshot.find(model, version, alias)
        if served is not None:
            self._used[served.name, served.version] = None
        return served

    def newest(self, model: str, alias: str | None = None) -> int | None:
        """Return the number of the version of an alias, or of the serving version."""
        return self._snapshot.pointed(model, alias)

    def is_deleted(self, model: str, version: int) -> bool:
        """Return whether a version was deleted."""
        return (model, version) in self._snapshot.deleted

    def get(self, model: str, version: int | None, alias: str | None = None) -> ServedModel:
        """Return a version, after the control plane has published it. Blocking: use it in a thread.

        Raise NotReadyError if it does not: the control plane then explains why.
        """
        served, request = self.hot(model, version, alias), LoadRequest(model, version, alias)
        if served is not None:
            return served
        with self._lock:
            is_first = request not in self._requests
            done = self._requests.setdefault(request, Future())
        # it may have been published meanwhile
        if is_first and (self.hot(model, version, alias) is not None or not self._send(request)):
            self._end_request(request)
        try:
            done.result(MAX_LOAD_S)
        except TimeoutError:
            self._end_request(request)
        served = self.hot(model, version, alias)
        if served is None:
            raise NotReadyError(f"Model {model} is not loaded.")
        return served

    def wake(self, model: str) -> None:
        """Let the control plane wake the learner of a model."""
        self._send(LearnerWake(model))

    def versions(self) -> Collection[Key]:
        """Return the versions in memory."""
        return self._snapshot.served.keys()

    def start_connection(self) -> Holdings:
        """Return the first message to a control plane; forget the payloads of the one before, which are sent again."""
        self._with_payload.clear()
        return Holdings({key: each.revision for key, each in self._snapshot.served.items()}, self._answers)

    def begin_answering(self) -> None:
        """Report that this data plane answers from now on."""
        self._answers = True
        self._send(Answering())

    def report_use(self) -> None:
        """Report which versions were used since the last report; call it every second."""
        used, self._used = self._used, {}
        served = self._snapshot.served
        streamed = frozenset(key for key in tuple(self._held.keys()) if key not in served)
        if used or streamed or self._streamed:
            self._send(VersionUse(tuple(used), streamed, self._confirmed))
        self._streamed = streamed

    def apply(self, message: Any) -> None:
        """Apply a publication; it takes milliseconds of a thread for a new version."""
        match message:
            case NewVersion():
                self._add_version(message)
            case NewRevision():
                self._add_revision(message)
            case NewPayload(key, number, model):
                self._with_payload.setdefault(key, {})[number] = _warmed(model)
            case StreamStates():
                self._replace_streams(message)
            case Pointers():
                self._move_pointers(message)
            case Published(number):
                self._confirmed = number
                self.ready.set()
                self._send(Confirmed(number))
            case NotLoaded(request):
                self._end_request(request)

    def _add_version(self, message: NewVersion) -> None:
        key, old = message.key, self._snapshot
        if key in old.served or key in old.deleted:
            return
        served = self._held.get(key)
        if served is None:
            base = message.base
            base.warm_up()
            served = ServedModel(*key, base, _warmed(base), frozenset(), Scales(base.scale), StreamPayloads())
        self._publish(old.with_version(served), served)
        freeze_version()

    def _add_revision(self, message: NewRevision) -> None:
        known = self._snapshot.served.get(message.key)
        if known is not None and known.revision < message.revision:
            model = _warmed(message.arrays.apply(known.base))
            served = replace(known, model=model, revision=message.revision)
            self._publish(self._snapshot.with_version(served), served)

    def _replace_streams(self, message: StreamStates) -> None:
        if (served := self._snapshot.served.get(message.key)) is None:
            return
        complete, models = message.complete, self._with_payload.get(message.key, {})
        factors = {} if complete else dict(served.scales.streams())
        for gone in message.without_factors:
            factors.pop(gone, None)
        served.scales.replace(factors | dict(message.factors))
        payloads = {} if complete else dict(served.payloads.streams())
        for gone in message.without_payloads:
            payloads.pop(gone, None)
        payloads |= {name: _payload(each, models) for name, each in message.payloads.items()}
        served.payloads.replace(payloads)
        used = {id(each.model) for each in payloads.values()}
        self._with_payload[message.key] = {number: each for number, each in models.items() if id(each) in used}

    def _move_pointers(self, message: Pointers) -> None:
        snapshot = self._snapshot.without_deleted(message.deleted)
        snapshot = replace(snapshot, aliases=message.aliases, serving=_existing(snapshot))
        for model, serving in message.serving.items():
            snapshot = snapshot.with_serving(model, serving)
        if message.kept is not None:
            snapshot = snapshot.without(snapshot.served.keys() - message.kept)
        self._with_payload = {key: each for key, each in self._with_payload.items() if key in snapshot.served}
        self._publish(snapshot)

    def _publish(self, snapshot: Snapshot, served: ServedModel | None = None) -> None:
        """Answer with a snapshot from now on. served: what is new in it."""
        if served is not None:
            self._held[served.name, served.version] = served
        models = {served.name} if served is not None else {model for model, _ in snapshot.served}
        self._snapshot = snapshot
        for model in models:
            self.waiters.wake(model)
        for request in tuple(self._requests):
            if snapshot.find(request.model, request.version, request.alias) is not None:
                self._end_request(request)

    def _end_request(self, request: LoadRequest) -> None:
        with self._lock:
            done = self._requests.pop(request, None)
        if done is not None:
            done.set_result(None)


def _existing(snapshot: Snapshot) -> dict[str, Serving]:
    """Return the serving versions that were not deleted."""
    return {model: each for model, each in snapshot.serving.items() if (model, each.version) not in snapshot.deleted}


def _payload(state: PayloadState, models: Mapping[int, TorqueModel]) -> StreamPayload:
    return StreamPayload(None if state.number is None else models[state.number], state.mass, state.received)


def _warmed(model: TorqueModel) -> TorqueModel:
    """Return a model after one prediction of each kind, which loads its arrays into memory."""
    warmed(model.fast)
    return warmed(model)
