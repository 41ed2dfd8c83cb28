"""The ingest of a stream's frames: rows with predictions, one for each sequence, in order."""

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
from lipcore.online.screening import StreamAnswers
from service.foundation.errors import ConflictError
from service.inference.predicting import QUANTITIES
from service.journal import log
from service.journal.arrivals import NewBatch, check_kind
from service.learning import owner
from service.learning.ingest.append import Arrival, ObservationLog, follow_rows
from service.learning.ingest.observations import REUSE_HINT, check_not_expired, row_limits
from service.models.loaded import ServedModel
from service.storage.database import EventRow


@dataclass(frozen=True)
class Frames:
    """N frames of one stream, with the answers of `served`."""

    model: str
    stream_id: str
    served: ServedModel
    sequences: NDArray[np.int64]
    """Sequence numbers, (N,), rising."""
    time: Array
    """Event time, (N,), Unix time, s."""
    q: Array
    """Position, (N, n). `dq`, `ddq`, `tau`, `mean` and `std` have the same shape."""
    dq: Array
    ddq: Array
    tau: Array
    mean: Array
    std: Array
    factor: Array | None = None
    """Factor on the half widths of the answers' intervals, (N, n); None if unknown."""
    loaded: bool = False
    """Whether the answers include a payload."""


@dataclass(frozen=True)
class FramesResult:
    """The result of frames that are durable."""

    through: int
    """Highest sequence of the frames."""
    accepted: int
    """Number of new rows that are learnt."""
    duplicates: int
    """Number of frames that were in the log already."""
    rejected: dict[str, int]
    """Number of new rows that are not learnt, by code."""
    revision: int
    """First revision that contains the frames."""


def observe_frames(observed: ObservationLog, frames: Frames) -> FramesResult:
    """Log frames, all of them or none. They are durable once this returns.

    Raise ConflictError for a sequence that was used otherwise or does not rise, ExpiredError, BusyError or
    StorageFullError.
    """
    for before, sequence in pairwise(frames.sequences.tolist()):
        if sequence <= before:
            raise _sequence_error(frames, sequence)
    monitor = observed.monitor(frames.served)
    observed.clocks.date_arrival()
    with observed.turn(monitor, frames.model):
        with observed.database.session() as session:
            options = owner.read_options(session, frames.model)
            source = log.stream(session, frames.model, frames.stream_id)
            check_kind(source, "frames")
            last = -1 if source is None else source.last
            before = log.read_history(session, frames.model, frames.stream_id, last + 1).below
            new = frames.sequences > last
            repeated = RepeatedFrames(0) if new.all() else _check_repeated(session, frames, ~new)
        monitor.counts["duplicates"] += repeated.frames
        if not new.any():
            return FramesResult(int(frames.sequences[-1]), 0, repeated.frames, {}, repeated.revision)
        bounds = row_limits(frames.served.model, options, observed.settings)
        q, dq, ddq, tau = numbers = [np.ascontiguousarray(getattr(frames, name)[new]) for name in QUANTITIES]
        # the service dates frames when they arrive, so their times need no check
        weights = independence.stream_weights(frames.time[new], None if before is None else before.last)
        rows = Rows(frames.time[new], q, dq, ddq, tau, check_rows(None, q, dq, ddq, tau, bounds), weights)
        followed = follow_rows(monitor, frames.served, frames.stream_id, source, last + 1, rows)
        rows = followed.rows
        carrying = frames.served.payloads.model_for(frames.stream_id)
        other_load = frames.loaded != (carrying is not None)
        answered = StreamAnswers(frames.mean, frames.std, frames.factor, other_load).take(new)
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
        answer = observed.append(
            monitor, frames.served, options, Arrival(batch, screened, source is None, place, play=followed.play)
        )
    observed.follow_up(monitor, frames.model)
    return FramesResult(int(sequences[-1]), answer.accepted, repeated.frames, answer.rejected, answer.revision)


@dataclass(frozen=True)
class RepeatedFrames:
    """Frames that are in the log already. revision: the first that contains the last of them."""

    frames: int
    revision: int = 0


def _check_repeated(session: Session, frames: Frames, old: NDArray[np.bool_]) -> RepeatedFrames:
    """Compare frames with those in the log under their sequences; raise ConflictError or ExpiredError."""
    places = np.flatnonzero(old)
    event: EventRow | None = None
    kept: dict[int, int] = {}
    for place in places.tolist():
        sequence = int(frames.sequences[place])
        if event is None or event.last_sequence is None or sequence > event.last_sequence:
            event, kept, rows = _read_logged(session, frames, sequence)
        if sequence not in kept:
            raise _sequence_error(frames, sequence)
        there = kept[sequence]
        for name in QUANTITIES:
            if not np.array_equal(getattr(frames, name)[place], getattr(rows, name)[there], equal_nan=True):
                raise ConflictError(
                    f"frame {sequence} of stream {frames.stream_id!r} was sent before with another {name}: {REUSE_HINT}"
                )
    assert event is not None
    start = log.start_of(session, frames.model, frames.served.version)
    return RepeatedFrames(len(places), max(event.number - start, 0))


def _read_logged(session: Session, frames: Frames, sequence: int) -> tuple[EventRow, dict[int, int], Rows]:
    """Return the batch of frames that contains a sequence, the index of each of its sequences, and its rows."""
    event = log.find_covering_batch(session, frames.model, frames.stream_id, sequence)
    if event is None:
        check_not_expired(log.stream(session, frames.model, frames.stream_id), sequence)
        raise _sequence_error(frames, sequence)
    ranges = Placement.from_json(event.report or {}).frames
    sequences = [number for first, last in ranges for number in range(first, last + 1)]
    return event, {number: place for place, number in enumerate(sequences)}, log.rows_of(event)


def _sequence_error(frames: Frames, sequence: int) -> ConflictError:
    return ConflictError(
        f"frame {sequence} of stream {frames.stream_id!r} comes after one with a higher sequence: sequences must "
        "increase"
    )


def _ranges(sequences: NDArray[np.int64]) -> tuple[tuple[int, int], ...]:
    """Return rising numbers as ranges (first, last)."""
    parts = np.split(sequences, np.flatnonzero(np.diff(sequences) > 1) + 1)
    return tuple((int(part[0]), int(part[-1])) for part in parts)


def _digest(sequences: NDArray[np.int64], numbers: list[Array]) -> str:
    content = hashlib.sha256(sequences.astype("<i8").tobytes())
    for values in numbers:
        content.update(values.astype("<f8").tobytes())
    return content.hexdigest()
