"""Messages between the service and the weigher process."""

from __future__ import annotations

from dataclasses import dataclass

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.payload.holding import PayloadTracker

Stream = tuple[str, int, str]
"""A model, its serving version and one of its streams."""
MAX_STREAMS = 1000
"""Max streams in the process. It drops the stream that was silent longest, and requests it when it sends again."""


@dataclass(frozen=True)
class PosteriorUpdate:
    """Learnt posterior of a version: its weights and root, see `CompactPosterior`."""

    weights: Array
    root: Array


@dataclass(frozen=True)
class StreamRows:
    """Rows of a stream that have predictions, with updates that the process may lack."""

    rows: Rows
    received: float
    """Unix time of the arrival, s."""
    event: int
    """Event that set the payload, see `Payloads.find_event`."""
    posterior: PosteriorUpdate | None = None
    """Learnt posterior of the version; None if the process has it."""
    watch: PayloadTracker | None = None
    """Payload of the stream; None if the process has it."""


@dataclass(frozen=True)
class WatchUpdate:
    """The payload of a stream after its latest rows."""

    stream: Stream
    watch: PayloadTracker
    """Outline of the payload's tracker, without its rows."""
    received: float
    """Unix time at which the latest rows arrived, s."""
    event: int
    """Event that set the payload before these rows, see `StreamRows`."""


@dataclass(frozen=True)
class UnknownStream:
    """Request for the payload of a stream that is unknown to the process."""

    stream: Stream


Message = WatchUpdate | UnknownStream
