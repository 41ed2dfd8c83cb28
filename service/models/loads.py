"""Models with the payload that each stream carries."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lipcore.model.torque_model import TorqueModel
from service.models.scales import RECENT_S


@dataclass(frozen=True)
class StreamPayload:
    """The payload of a stream."""

    model: TorqueModel | None
    """Model with this payload; None if the stream has no payload."""
    mass: tuple[float, float] | None
    """Mean and standard deviation, kg; None if the stream has no payload."""
    received: float
    """Unix time of the stream's last observation batch, s."""


class StreamPayloads:
    """Payload models of a version's streams; any thread may read while one thread replaces them.

    A version keeps one instance as long as the service runs, as it does its `Scales`. changed: called after each
    replacement.
    """

    def __init__(self, changed: Callable[[], None] | None = None) -> None:
        self._changed = changed
        self._streams: Mapping[str, StreamPayload] = {}
        self._default: StreamPayload | None = None
        self._given: Mapping[str, StreamPayload] = {}
        self.default_model: TorqueModel | None = None
        """Model for queries without a stream: with the payload declared for all, or that of the only recent stream.
        None means the version without payload.
        """
        self.fresh = True
        """Whether `replace` was never called."""

    def model_for(self, stream_id: str | None) -> TorqueModel | None:
        """Return the model of a stream, the default model if `stream_id` is None.

        None means the version without payload.
        """
        if stream_id is None:
            return self.default_model
        known = self._streams.get(stream_id, self._default)
        return None if known is None else known.model

    def mass(self, stream_id: str | None) -> tuple[float, float] | None:
        """Return the payload mass of a stream, mean and standard deviation in kg; None if it has no payload."""
        known = self._default if stream_id is None else self._streams.get(stream_id, self._default)
        return None if known is None else known.mass

    def masses(self) -> dict[str, tuple[float, float] | None]:
        """Return the payload mass of every stream that has reported one, as `mass` does."""
        return {name: each.mass for name, each in self._streams.items()}

    def streams(self) -> Mapping[str, StreamPayload]:
        """Return the payloads of all streams, as `replace` was given them."""
        return self._given

    def replace(self, streams: Mapping[str, StreamPayload]) -> None:
        """Replace the payloads of all streams; the empty name is the default for other streams."""
        self._default = streams.get("")
        known = {name: each for name, each in streams.items() if name}
        latest = max((each.received for each in known.values()), default=0.0)
        recent = [each for each in known.values() if each.received >= latest - RECENT_S]
        default = None if self._default is None else self._default.model
        self.default_model = recent[0].model if len(recent) == 1 else default
        self.fresh = False
        self._streams, self._given = known, streams
        if self._changed is not None:
            self._changed()
