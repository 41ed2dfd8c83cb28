"""Factors on the widths of a version's intervals, as the measurements that its streams bring have made them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lipcore.data.samples import Array
from lipcore.online.adaptive import widest

RECENT_S = 60.0
"""Streams that taught within so long of the newest one are asked about, s."""


@dataclass(frozen=True)
class Factor:
    """Of a stream: values (n,) for its own answers, and `others` (n,), of what was not kept out of it; received: when
    the batch came that made them, Unix time, s. doubted: whether the stream did not fit from its first second on, and
    nobody has confirmed it: no others are answered with its factors."""

    values: Array
    others: Array
    received: float
    doubted: bool = False


class Scales:
    """The factors that a version answers with now; any thread may read while one replaces them.

    One of these belongs to a version for as long as the service runs, whatever it learns: all of its revisions have it.
    own: (n,), what the training has proved, which holds until streams say otherwise.
    """

    def __init__(self, own: Array) -> None:
        self._own = own
        self._streams: Mapping[str, Factor] = {}
        self._widest = own
        self.asked: list[float] = own.tolist()

    def of(self, stream_id: str | None) -> Array:
        """Those of a stream, (n,), the version's own where it has taught nothing; of no stream those of questions,
        `asked`.

        A question of HTTP belongs to no stream: it has the largest of those of the recent streams and its own."""
        if stream_id is None:
            return self._widest
        known = self._streams.get(stream_id)
        return self._own if known is None else known.values

    def take(self, streams: Mapping[str, Factor]) -> None:
        """Answer with these from now on."""
        trusted = [each for each in streams.values() if not each.doubted]
        latest = max((each.received for each in trusted), default=0.0)
        recent = [each.others for each in trusted if each.received >= latest - RECENT_S]
        self._widest = widest(recent, self._own)
        self.asked = self._widest.tolist()
        self._streams = streams
