"""Factors on the interval widths of a version, adapted to the measurements of its streams."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lipcore.data.samples import Array
from lipcore.online.adaptive import widest

RECENT_S = 60.0
"""Queries without a stream use streams with a last batch at most this much older than the newest, s."""


@dataclass(frozen=True)
class Factor:
    """Width factors of one stream."""

    values: Array
    """Factors for queries of this stream, (n,)."""
    others: Array
    """Factors for queries without a stream, (n,); computed from accepted observations only."""
    received: float
    """Unix time of arrival of the batch that set the factors, s."""
    doubted: bool = False
    """Whether the stream disagrees with the version since its first second and nobody has confirmed the stream. Its
    factors then apply only to its own queries.
    """


class Scales:
    """Current width factors of a version; any thread may read while one thread replaces them.

    A version keeps one instance as long as the service runs; all of its revisions share it. `own` (n,) are the factors
    from the training, used until streams have their own. changed: called after each replacement.
    """

    def __init__(self, own: Array, changed: Callable[[], None] | None = None) -> None:
        self._own, self._changed = own, changed
        self._streams: Mapping[str, Factor] = {}
        self._widest = own
        self.default_factors: list[float] = own.tolist()
        """Factors of the default model, per joint."""

    def of(self, stream_id: str | None) -> Array:
        """Return the factors of a stream, (n,): the version's own if it has sent no observations.

        A query without a stream gets `default_factors`, the largest of the version's own and those of the recent
        streams.
        """
        if stream_id is None:
            return self._widest
        known = self._streams.get(stream_id)
        return self._own if known is None else known.values

    def streams(self) -> Mapping[str, Factor]:
        """Return the factors of all streams."""
        return self._streams

    def replace(self, streams: Mapping[str, Factor]) -> None:
        """Replace the factors of all streams."""
        trusted = [each for each in streams.values() if not each.doubted]
        latest = max((each.received for each in trusted), default=0.0)
        recent = [each.others for each in trusted if each.received >= latest - RECENT_S]
        self._widest = widest(recent, self._own)
        self.default_factors = self._widest.tolist()
        self._streams = streams
        if self._changed is not None:
            self._changed()
