"""Frames of a stream on their way into the log: rows that are predicted already, one a sequence, in order."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.online import screening
from lipcore.online.batch import Placement, Rows
from lipcore.online.gates import check_rows
from lipcore.online.screening import Answered
from service.foundation.errors import ConflictError
from service.inference.predicting import QUANTITIES
from service.journal import log
from service.journal.arrivals import NewBatch, check_kind
from service.learning import owner
from service.learning.ingest.append import Arrival, ObservationLog
from service.learning.ingest.observations import ONCE, check_kept, row_limits
from service.models.loaded import Served
from service.storage.database import EventRow


@dataclass(frozen=True)
class Frames:
    """N frames of one stream with what `served` answered. sequences: (N,), rising; time: (N,) Unix time, s. q, dq, ddq,
    tau, mean, std: (N, n). factor: (N, n), on the half widths that they were answered with, where that is known.
    loaded: whether they were answered with a load."""

    model: str
    stream_id: str
    served: Served
    sequences: NDArray[np.int64]
    time: Array
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    mean: Array
    std: Array
    factor: Array | None = None
    loaded: bool = False


@dataclass(frozen=True)
class FramesResult:
    """Durable frames. through: highest sequence of them; accepted, rejected (by code): of those that are new.
    duplicates: frames that were in the log; revision: answers from it on contain the frames."""

    through: int
    accepted: int
    duplicates: int
    rejected: dict[str, int]
    revision: int


def observe_frames(observed: ObservationLog, frames: Frames) -> FramesResult:
    """Log frames; once this returns they are durable. All of them or none. Raise ConflictError
    for a sequence that was used for something else or does not rise, ExpiredError, BusyError or StorageFullError."""
    for before, sequence in pairwise(frames.sequences.tolist()):
        if sequence <= before:
            raise _order(frames, sequence)
    monitor = observed.monitor(frames.served)
    observed.clocks.arrival()
    with observed.turn(monitor, frames.model):
        with observed.database.session() as session:
            options = owner.options(session, frames.model)
            source = log.stream(session, frames.model, frames.stream_id)
            check_kind(source, "frames")
            last = -1 if source is None else source.last
            before = log.past(session, frames.model, frames.stream_id, last + 1).below
            new = frames.sequences > last
            repeated = Repeated(0) if new.all() else _repeated(session, frames, ~new)
        monitor.counts["duplicates"] += repeated.frames
        if not new.any():
            return FramesResult(int(frames.sequences[-1]), 0, repeated.frames, {}, repeated.revision)
        bounds = row_limits(frames.served.model, options, observed.settings)
        q, dq, ddq, tau = numbers = [np.ascontiguousarray(getattr(frames, name)[new]) for name in QUANTITIES]
        # frames are dated by the service as they arrive, so that their times need no check
        weights = independence.stream_weights(frames.time[new], None if before is None else before.last)
        rows = Rows(frames.time[new], q, dq, ddq, tau, check_rows(None, q, dq, ddq, tau, bounds), weights)
        carrying = frames.served.loads.of(frames.stream_id)
        other_load = frames.loaded != (carrying is not None)
        answered = Answered(frames.mean, frames.std, frames.factor, other_load).take(new)
        screened = screening.predict(rows, frames.served, slice(0, len(rows)), answered, carrying)
        sequences = frames.sequences[new]
        batch = NewBatch(
            frames.stream_id,
            "frames",
            int(sequences[0]),
            int(sequences[-1]),
            _digest(sequences, numbers),
            0.0,
            float(frames.time[-1]),
            frames.served.version,
            frames.served.revision,
            rows,
        )
        place = Placement((0, len(rows)), frames=_ranges(sequences))
        answer = observed.append(monitor, frames.served, options, Arrival(batch, screened, source is None, place))
    observed.follow_up(monitor, frames.model)
    return FramesResult(int(sequences[-1]), answer.accepted, repeated.frames, answer.rejected, answer.revision)


@dataclass(frozen=True)
class Repeated:
    """Frames that are in the log already. revision: from which on answers contain the last of them."""

    frames: int
    revision: int = 0


def _repeated(session: Session, frames: Frames, old: NDArray[np.bool_]) -> Repeated:
    """Compare frames with what the log has under their sequences; raise ConflictError or ExpiredError."""
    places = np.flatnonzero(old)
    event: EventRow | None = None
    kept: dict[int, int] = {}
    for place in places.tolist():
        sequence = int(frames.sequences[place])
        if event is None or event.last_sequence is None or sequence > event.last_sequence:
            event, kept, rows = _logged(session, frames, sequence)
        if sequence not in kept:
            raise _order(frames, sequence)
        there = kept[sequence]
        for name in QUANTITIES:
            if not np.array_equal(getattr(frames, name)[place], getattr(rows, name)[there], equal_nan=True):
                raise ConflictError(
                    f"frame {sequence} of stream {frames.stream_id!r} has come before with another {name}: {ONCE}"
                )
    assert event is not None
    start = log.start_of(session, frames.model, frames.served.version)
    return Repeated(len(places), max(event.number - start, 0))


def _logged(session: Session, frames: Frames, sequence: int) -> tuple[EventRow, dict[int, int], Rows]:
    """The batch of frames that a sequence lies in, the place of each of its sequences, and its rows."""
    event = log.covering(session, frames.model, frames.stream_id, sequence)
    if event is None:
        check_kept(log.stream(session, frames.model, frames.stream_id), sequence)
        raise _order(frames, sequence)
    ranges = Placement.from_json(event.report or {}).frames
    sequences = [number for first, last in ranges for number in range(first, last + 1)]
    return event, {number: place for place, number in enumerate(sequences)}, log.rows_of(event)


def _order(frames: Frames, sequence: int) -> ConflictError:
    return ConflictError(
        f"frame {sequence} of stream {frames.stream_id!r} comes after one of a higher sequence: sequences must rise"
    )


def _ranges(sequences: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    """Rising numbers as ranges (first, last)."""
    parts = np.split(sequences, np.flatnonzero(np.diff(sequences) > 1) + 1)
    return tuple((int(part[0]), int(part[-1])) for part in parts)


def _digest(sequences: NDArray[np.int64], numbers: list[Array]) -> str:
    content = hashlib.sha256(sequences.astype("<i8").tobytes())
    for values in numbers:
        content.update(values.astype("<f8").tobytes())
    return content.hexdigest()
