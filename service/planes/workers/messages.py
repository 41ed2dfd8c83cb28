"""Messages between a worker and the control plane. Large arguments and results travel through an arena."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from service.models.loads import StreamPayload, StreamPayloads
from service.models.scales import Factor, Scales
from service.models.served import ServedModel
from service.planes.workers.arena import Arena
from service.runtime.pages import Buffer

MIN_SHARED_BYTES = 16 * 1024
"""Bytes from which on a part of a value travels through an arena."""


class Packed(NamedTuple):
    """A value: its pickle, empty if that is the first part in an arena, and the parts in the arena."""

    data: bytes
    spans: list[tuple[int, int]]

    @classmethod
    def of(cls, value: Any, arena: Arena) -> Packed:
        """Pack a value, and write its large parts into an arena."""
        parts: list[pickle.PickleBuffer] = []
        data = pickle.dumps(_with_buffers(value), 5, buffer_callback=parts.append)
        buffers: list[Buffer] = [each.raw() for each in parts]
        if len(data) < MIN_SHARED_BYTES:
            return cls(data, arena.write(buffers))
        return cls(b"", arena.write([data, *buffers]))

    def read(self, buffers: Sequence[Buffer]) -> Any:
        """Return the value. buffers: the content of `spans`."""
        data, parts = (self.data, buffers) if self.data else (buffers[0], buffers[1:])
        return pickle.loads(data, buffers=parts)  # noqa: S301 - from a process of this service


def _with_buffers(value: Any) -> Any:
    """Mark large bytes in a tuple, or alone, as a part of their own: pickle would copy them."""
    if isinstance(value, bytes):
        return pickle.PickleBuffer(value) if len(value) >= MIN_SHARED_BYTES else value
    if type(value) is tuple:
        return tuple(map(_with_buffers, value))
    return value


@dataclass(frozen=True)
class VersionState:
    """What a version answers to queries without a stream. Its models are known by number."""

    name: str
    version: int
    revision: int
    datasets: frozenset[str]
    model: int
    payload_model: int | None
    """Default model, None if it has no payload."""
    factors: Array
    """Width factors, (n,)."""

    @classmethod
    def of(cls, served: ServedModel, number: Callable[[TorqueModel], int]) -> VersionState:
        """Return the state of a version. number: returns the number of a model."""
        default = served.default_model
        return cls(
            served.name,
            served.version,
            served.revision,
            served.datasets,
            number(served.model),
            None if default is served.model else number(default),
            served.scales.of(None),
        )

    def served(self, models: dict[int, TorqueModel]) -> ServedModel:
        """Return the version, with models by number."""
        model = models[self.model]
        made = ServedModel(
            self.name,
            self.version,
            model,
            model,
            self.datasets,
            Scales(model.scale),
            StreamPayloads(),
            self.revision,
        )
        self.update(made, models)
        return made

    def update(self, served: ServedModel, models: dict[int, TorqueModel]) -> None:
        """Replace the width factors and the default model of a version that this process has."""
        served.scales.replace({"": Factor(self.factors, self.factors, 0.0)})
        payload = None if self.payload_model is None else StreamPayload(models[self.payload_model], None, 0.0)
        served.payloads.replace({} if payload is None else {"": payload})


class Arenas(NamedTuple):
    """First message to a worker, with the file descriptors of the arena that it reads and the one that it writes."""


class NewModel(NamedTuple):
    """A model for a worker, and its number."""

    number: int
    model: TorqueModel


class Task(NamedTuple):
    """A call of a function with a storage, versions and further arguments.

    versions: one, or several as a tuple; dropped: numbers of models that are not needed any more.
    """

    function: Callable[..., Any]
    versions: VersionState | tuple[VersionState, ...]
    given: Packed
    dropped: tuple[int, ...]


class Done(NamedTuple):
    """The result of a task."""

    result: Packed


class Failed(NamedTuple):
    """The error of a task."""

    error: Exception
