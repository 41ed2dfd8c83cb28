"""What the weigher process is given, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.payload.holding import Watch

Stream = tuple[str, int, str]
"""A model, the version that answers, and one of its streams."""
MOST_STREAMS = 1000
"""Streams that the process knows; the one that was silent for longest is forgotten, and asked for again."""


@dataclass(frozen=True)
class Revised:
    """What a version has learnt: weights and root of its posterior, see `CompactPosterior`."""

    weights: Array
    root: Array


@dataclass(frozen=True)
class Unweighed:
    """Rows of a stream that have an answer. received: Unix time, s; said: see `Payloads.said`.

    What the process may not know yet: revised: what the version has learnt; known: what the stream carries.
    """

    rows: Rows
    received: float
    said: int
    revised: Revised | None = None
    known: Watch | None = None


@dataclass(frozen=True)
class Weighed:
    """What a stream carries after its latest rows. watch: without these rows; received, said: of them."""

    stream: Stream
    watch: Watch
    received: float
    said: int


@dataclass(frozen=True)
class Asked:
    """The process does not know a stream, whose rows have come."""

    stream: Stream


Message = Weighed | Asked
