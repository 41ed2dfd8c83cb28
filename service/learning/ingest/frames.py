"""Frames of a stream on their way into the log: rows that are predicted already, one a sequence, in order."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.gates import check_rows
from service.foundation.errors import ConflictError
from service.journal import log
from service.learning.ingest import screening
from service.learning.ingest.batches import check_kept
from service.learning.ingest.intake import Arrival, Intake, check_kind, enabled
from service.models.loaded import Served
from service.storage.database import EventRow

NUMBERS = ("q", "dq", "ddq", "tau")


@dataclass(frozen=True)
class Frames:
    """N frames of one stream with what `served` answered. sequences: (N,), rising; time: (N,) Unix time, s.

    q, dq, ddq, tau, mean, std: (N, n).
    """

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


@dataclass(frozen=True)
class FramesResult:
    """Durable frames. through: highest sequence of them; accepted, rejected (by code): of those that are new.

    duplicates: frames that were in the log; revision: answers from it on contain the frames.
    """

    through: int
    accepted: int
    duplicates: int
    rejected: dict[str, int]
    revision: int


def observe_frames(intake: Intake, frames: Frames) -> FramesResult:
    """Log frames; once this returns they are durable. All of them or none.

    Raise LearningDisabledError, ConflictError for a sequence that was used for something else or does not rise,
    ExpiredError, BusyError or StorageFullError.
    """
    _check_order(frames)
    monitor = intake.monitor(frames.served)
    with intake.turn(monitor, frames.model):
        with intake.database.session() as session:
            options = enabled(session, frames.model)
            source = log.stream(session, frames.model, frames.stream_id)
            check_kind(source, "frames")
            last = -1 if source is None else source.last
            before, _ = log.neighbours(session, frames.model, frames.stream_id, last + 1)
            new = frames.sequences > last
            repeated = Repeated(0) if new.all() else _repeated(session, frames, ~new)
        monitor.counts["duplicates"] += repeated.frames
        if not new.any():
            return FramesResult(int(frames.sequences[-1]), 0, repeated.frames, {}, repeated.revision)
        model = frames.served.model
        bounds = screening.limits(model, options, intake.settings)
        q, dq, ddq, tau = numbers = [np.ascontiguousarray(getattr(frames, name)[new]) for name in NUMBERS]
        # frames are dated by the service as they arrive, so that their times need no check
        weights = independence.stream_weights(frames.time[new], None if before is None else before.last)
        rows = Rows(frames.time[new], q, dq, ddq, tau, check_rows(None, q, dq, ddq, tau, bounds), weights)
        screened = screening.answered(rows, frames.mean[new], frames.std[new], model)
        sequences = frames.sequences[new]
        arrival = Arrival(
            frames.stream_id,
            "frames",
            int(sequences[0]),
            int(sequences[-1]),
            _digest(sequences, numbers),
            len(rows),
            0.0,
            None,
            float(frames.time[-1]),
        )
        details = {"derived": None, "frames": _ranges(sequences)}
        report = intake.append(monitor, frames.served, options, arrival, screened, details)
    intake.follow_up(monitor, frames.model)
    return FramesResult(int(sequences[-1]), report["accepted"], repeated.frames, report["rejected"], report["revision"])


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
        for name in NUMBERS:
            if not np.array_equal(getattr(frames, name)[place], getattr(rows, name)[there], equal_nan=True):
                raise ConflictError(
                    f"frame {sequence} of stream {frames.stream_id!r} has come before with another {name}: a sequence "
                    "is used once"
                )
    assert event is not None
    start = log.start_of(session, frames.model, frames.served.version)
    return Repeated(len(places), max(event.number - start, 0))


def _logged(session: Session, frames: Frames, sequence: int) -> tuple[EventRow, dict[int, int], Rows]:
    """The batch of frames that a sequence lies in, the place of each of its sequences, and its rows."""
    event = log.covering(session, frames.model, frames.stream_id, sequence)
    if event is None:
        check_kept(session, frames.model, frames.stream_id, sequence)
        raise _order(frames, sequence)
    data = session.scalar(select(EventRow.payload).where(EventRow.seq == event.seq))
    assert data is not None
    ranges = (event.report or {})["frames"]
    sequences = [number for first, last in ranges for number in range(first, last + 1)]
    return event, {number: place for place, number in enumerate(sequences)}, log.decode(data)


def _order(frames: Frames, sequence: int) -> ConflictError:
    return ConflictError(
        f"frame {sequence} of stream {frames.stream_id!r} comes after one of a higher sequence: sequences must rise"
    )


def _check_order(frames: Frames) -> None:
    for before, sequence in pairwise(frames.sequences.tolist()):
        if sequence <= before:
            raise _order(frames, sequence)


def _ranges(sequences: NDArray[np.int64]) -> list[list[int]]:
    """Rising numbers as ranges [first, last]."""
    parts = np.split(sequences, np.flatnonzero(np.diff(sequences) > 1) + 1)
    return [[int(part[0]), int(part[-1])] for part in parts]


def _digest(sequences: NDArray[np.int64], numbers: list[Array]) -> str:
    content = hashlib.sha256(sequences.astype("<i8").tobytes())
    for values in numbers:
        content.update(values.astype("<f8").tobytes())
    return content.hexdigest()
