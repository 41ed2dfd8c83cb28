"""Width factors and payloads of streams: changes since the last publication to a data plane."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from lipcore.model.torque_model import TorqueModel
from service.models.loads import StreamPayload
from service.models.scales import Factor
from service.models.served import Key, ServedModel
from service.planes.publications import NewPayload, PayloadState, StreamStates

Mark = tuple[Any, ...]
"""Values by which a changed stream is recognised."""


class PayloadNumbers:
    """Numbers of the models with payloads that streams have now."""

    def __init__(self) -> None:
        self._next = itertools.count(1)
        self._known: dict[int, tuple[int, TorqueModel]] = {}

    def of(self, model: TorqueModel | None) -> int | None:
        """Return the number of a model, None for no model."""
        if model is None:
            return None
        if id(model) not in self._known:  # the model is kept, so that no other gets its id
            self._known[id(model)] = next(self._next), model
        return self._known[id(model)][0]

    def keep(self, served: Iterable[ServedModel]) -> None:
        """Forget all models that no stream of these versions has."""
        used = {id(each.model) for version in served for each in version.payloads.streams().values()}
        self._known = {name: each for name, each in self._known.items() if name in used}


class SentStreams:
    """The streams of one version, as they were sent to one data plane."""

    def __init__(self, key: Key) -> None:
        self._key = key
        self._seen: tuple[Mapping[str, Factor], Mapping[str, StreamPayload]] | None = None
        self._factors: dict[str, Mark] = {}
        self._payloads: dict[str, Mark] = {}
        self._numbers: set[int] = set()

    def changes(self, served: ServedModel, numbers: PayloadNumbers) -> Iterator[NewPayload | StreamStates]:
        """Return the messages that tell what has changed, models first, and count them as sent."""
        factors, payloads = served.scales.streams(), served.payloads.streams()
        if self._seen is not None and self._seen[0] is factors and self._seen[1] is payloads:
            return
        models = {numbers.of(each.model): each.model for each in payloads.values()}
        for number, model in models.items():
            if number is not None and model is not None and number not in self._numbers:
                yield NewPayload(self._key, number, model)
        states = {name: _state(each, numbers) for name, each in payloads.items()}
        factor_marks = {name: _mark(each) for name, each in factors.items()}
        payload_marks: dict[str, Mark] = {name: (each,) for name, each in states.items()}
        yield StreamStates(
            self._key,
            {name: factors[name] for name in _changed(self._factors, factor_marks)},
            {name: states[name] for name in _changed(self._payloads, payload_marks)},
            tuple(self._factors.keys() - factors.keys()),
            tuple(self._payloads.keys() - payloads.keys()),
            complete=self._seen is None,
        )
        self._seen = factors, payloads
        self._factors, self._payloads = factor_marks, payload_marks
        self._numbers = {number for number in models if number is not None}


def _state(payload: StreamPayload, numbers: PayloadNumbers) -> PayloadState:
    return PayloadState(numbers.of(payload.model), payload.mass, payload.received)


def _mark(factor: Factor) -> Mark:
    # equal arrays are other objects after each batch of any stream
    return factor.received, factor.doubted, factor.values.tobytes(), factor.others.tobytes()


def _changed(old: Mapping[str, Mark], new: Mapping[str, Mark]) -> Iterator[str]:
    return (name for name, mark in new.items() if mark != old.get(name))
