"""A batch on its way into the log: in the model's joint order, known again if repeated, checked, predicted, judged; and
frames of a stream, rows that are predicted already, one a sequence, in order."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from struct import pack

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online import screening
from lipcore.online.batch import Rows
from lipcore.online.gates import check_rows
from lipcore.online.screening import Answered
from service.contract.observations import Derivation, ExpiredError, ObservationRequest, ObservationResponse, State
from service.foundation.errors import ConflictError, invalid_request
from service.inference.predicting import QUANTITIES, check_shapes
from service.journal import log
from service.journal.log import NewBatch, StreamKind, check_kind
from service.learning import owner
from service.learning.ingest import dating, deriving
from service.learning.ingest.dating import Measured, StreamTime
from service.learning.ingest.intake import Intake
from service.learning.ingest.monitor import Monitor
from service.models.loaded import Served
from service.storage.database import EventRow

MAX_ROWS = 5000
"""Rows of one observation batch."""
ONCE = "a sequence is used once, so a new run needs a stream_id of its own, or higher sequences"


def observe_batch(intake: Intake, model: str, request: ObservationRequest) -> ObservationResponse:
    """Take a batch; once this returns it is durable. Raise NotFoundError, InvalidRequestError,
    ConflictError, ExpiredError, BusyError or StorageFullError."""
    served, received = intake.loaded.get(model, None), intake.arrival()
    batch = measured(request, served.model)
    content = digest(batch)
    monitor = intake.monitor(served)
    with intake.turn(monitor, model):
        answer = _take(intake, monitor, served, request, batch, content, received)
    intake.follow_up(monitor, model)
    return answer


def _take(
    intake: Intake,
    monitor: Monitor,
    served: Served,
    request: ObservationRequest,
    batch: Measured,
    content: str,
    received: float,
) -> ObservationResponse:
    """Log a batch that is new, in a turn of its model; one that is in the log is acknowledged again."""
    model, stream_id, sequence = key = served.name, request.stream_id, request.sequence
    with intake.database.session() as session:
        options, source = owner.options(session, model), log.stream(session, model, stream_id)
        check_kind(source, "batches")
        # beyond the last of its stream it is new
        known = source is not None and sequence <= source.last
        answer = acknowledged(session, *key, content) if known else None
        if answer is not None:
            monitor.counts["duplicates"] += 1
            return answer
        bounds = dating.row_limits(served.model, options, intake.settings)
        before, after = log.neighbours(session, *key)
        clock = StreamTime.of(source, sequence, before, after, received)
        previous = before.last if before is not None and clock.adjacent else None
        dated = dating.dated(batch, clock, bounds, previous, options.forgetting_s)
        rows, own, derived = dated.rows, slice(0, len(batch)), None
        if batch.ddq is None and batch.t is not None:
            rows, own, derived = deriving.derive(session, *key, rows, batch.t, bounds)
    screened = screening.predict(rows, served, own, carrying=served.loads.of(stream_id))
    new = _new(served, stream_id, "batches", (sequence, sequence), content, rows, dated.offset, received)
    waited = None if derived is None else Derivation(ddq=derived).model_dump()
    details = {"derived": waited, "span": dated.span, "leap": dated.leap}
    return ObservationResponse.model_validate(intake.append(monitor, served, options, new, screened, details))


def _new(
    served: Served,
    stream_id: str,
    kind: StreamKind,
    ends: tuple[int, int],
    content: str,
    rows: Rows,
    offset: float,
    received: float,
) -> NewBatch:
    """A batch that is yet to be judged. ends: its first and last sequence; content: digest of it."""
    return NewBatch(
        stream_id, kind, *ends, content, offset, received, served.version, served.revision, rows, report={}, record=None
    )


def measured(request: ObservationRequest, model: TorqueModel) -> Measured:
    """Check a request's shapes and joints and bring its columns in order; raise InvalidRequestError."""
    check_shapes(request, model)
    rows = 1 if request.q.ndim == 1 else len(request.q)
    if rows > MAX_ROWS:
        raise invalid_request("q", f"{rows} rows", f"at most {MAX_ROWS} in one batch")
    if request.t is not None and request.t.shape != (rows,):
        raise invalid_request("t", f"{len(request.t)} numbers long", f"{rows}, one a row of q")
    if request.t is None and request.ddq is None:
        raise invalid_request("ddq", "missing, and t too", "accelerations, or times to derive them from dq with")
    order = slice(None) if request.joint_names is None else columns(request.joint_names, model.joint_names)
    q, dq, tau = (_ordered(values, order) for values in (request.q, request.dq, request.tau))
    return Measured(request.t, q, dq, None if request.ddq is None else _ordered(request.ddq, order), tau)


def _ordered(values: Array, order: slice | list[int]) -> Array:
    return np.ascontiguousarray(np.atleast_2d(values)[:, order])


def columns(given: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Place of each of the model's joints among those given; raise InvalidRequestError naming what does not fit."""
    for index, name in enumerate(given):
        if name not in joints:
            raise invalid_request(f"joint_names[{index}]", name, f"one of the model's joints: {', '.join(joints)}")
        if name in given[:index]:
            raise invalid_request(f"joint_names[{index}]", name, "each joint once")
    if missing := [name for name in joints if name not in given]:
        raise invalid_request("joint_names", f"without {', '.join(missing)}", "all of the model's joints")
    return [given.index(name) for name in joints]


def digest(rows: Measured) -> str:
    """Sha256 over shapes and numbers: equal for equal content, whatever its JSON or joint order."""
    content = hashlib.sha256(pack("<2Q", *rows.q.shape))
    for values in (rows.t, rows.q, rows.dq, rows.ddq, rows.tau):
        content.update(b"-" if values is None else b"+")
        if values is not None:
            # one zero and one NaN of the several that there are
            canonical = np.where(np.isnan(values), np.nan, values + 0.0)
            content.update(canonical.astype("<f8").tobytes())
    return content.hexdigest()


def acknowledged(
    session: Session, model: str, stream_id: str, sequence: int, content: str
) -> ObservationResponse | None:
    """The first acknowledgement of a batch that is in the log, with its state now; None for one that is new.

    Raise ConflictError where the log has another content under its sequence, ExpiredError where the log no longer
    reaches back to it.
    """
    event = log.find_batch(session, model, stream_id, sequence)
    if event is None:
        check_kept(session, model, stream_id, sequence)
        return None
    if event.digest != content:
        raise ConflictError(f"batch {sequence} of stream {stream_id!r} has come before with other content: {ONCE}")
    return ObservationResponse.model_validate(
        {**(event.report or {}), "duplicate": True, "state": state(session, event)}
    )


def check_kept(session: Session, model: str, stream_id: str, sequence: int) -> None:
    """Raise ExpiredError where a batch that is not in the log may have been there."""
    source = log.stream(session, model, stream_id)
    if source is not None and log.is_forgotten(source, sequence):
        raise ExpiredError(
            f"it is not known any more whether batch {sequence} of stream {stream_id!r} has come before: batches up to "
            f"{source.forgotten} are no longer kept"
        )


def state(session: Session, event: EventRow) -> State:
    """Whether a batch of the log still teaches, and if not, why."""
    if not event.void:
        return "learnt"
    return "unlearnt" if log.about(session, event, "unlearn") else "rolled_back"


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


def observe_frames(intake: Intake, frames: Frames) -> FramesResult:
    """Log frames; once this returns they are durable. All of them or none. Raise ConflictError
    for a sequence that was used for something else or does not rise, ExpiredError, BusyError or StorageFullError."""
    for before, sequence in pairwise(frames.sequences.tolist()):
        if sequence <= before:
            raise _order(frames, sequence)
    monitor = intake.monitor(frames.served)
    intake.arrival()
    with intake.turn(monitor, frames.model):
        with intake.database.session() as session:
            options = owner.options(session, frames.model)
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
        bounds = dating.row_limits(model, options, intake.settings)
        q, dq, ddq, tau = numbers = [np.ascontiguousarray(getattr(frames, name)[new]) for name in QUANTITIES]
        # frames are dated by the service as they arrive, so that their times need no check
        weights = independence.stream_weights(frames.time[new], None if before is None else before.last)
        rows = Rows(frames.time[new], q, dq, ddq, tau, check_rows(None, q, dq, ddq, tau, bounds), weights)
        carrying = frames.served.loads.of(frames.stream_id)
        other_load = frames.loaded != (carrying is not None)
        answered = Answered(frames.mean, frames.std, frames.factor, other_load).take(new)
        screened = screening.predict(rows, frames.served, slice(0, len(rows)), answered, carrying)
        sequences = frames.sequences[new]
        ends = int(sequences[0]), int(sequences[-1])
        content = _digest(sequences, numbers)
        batch = _new(frames.served, frames.stream_id, "frames", ends, content, rows, 0.0, float(frames.time[-1]))
        details = {"derived": None, "span": None, "frames": _ranges(sequences)}
        report = intake.append(monitor, frames.served, options, batch, screened, details)
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
        check_kept(session, frames.model, frames.stream_id, sequence)
        raise _order(frames, sequence)
    ranges = (event.report or {})["frames"]
    sequences = [number for first, last in ranges for number in range(first, last + 1)]
    return event, {number: place for place, number in enumerate(sequences)}, log.rows_of(event)


def _order(frames: Frames, sequence: int) -> ConflictError:
    return ConflictError(
        f"frame {sequence} of stream {frames.stream_id!r} comes after one of a higher sequence: sequences must rise"
    )


def _ranges(sequences: NDArray[np.int64]) -> list[list[int]]:
    """Rising numbers as ranges [first, last]."""
    parts = np.split(sequences, np.flatnonzero(np.diff(sequences) > 1) + 1)
    return [[int(part[0]), int(part[-1])] for part in parts]


def _digest(sequences: NDArray[np.int64], numbers: list[Array]) -> str:
    content = hashlib.sha256(sequences.astype("<i8").tobytes())
    for values in numbers:
        content.update(values.astype("<f8").tobytes())
    return content.hexdigest()
