"""The ingest of an observation batch: check it, detect a repetition, date its rows and predict them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from struct import pack

import numpy as np
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online import acceleration, screening
from lipcore.online.acceleration import DerivationError
from lipcore.online.batch import Placement, Rows
from lipcore.online.dating import DatedRows, MeasuredRows, StreamTime, date_rows
from lipcore.online.gates import RowLimits
from service.contract.observations import (
    Derivation,
    DerivedAcceleration,
    ExpiredError,
    LearningOptions,
    ObservationRequest,
    ObservationResponse,
    State,
)
from service.datasets.mapping import checks
from service.foundation.errors import ConflictError, invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import check_shapes, check_times
from service.journal import log
from service.journal.arrivals import NewBatch, check_kind, is_forgotten
from service.journal.log import StreamHistory
from service.learning import owner
from service.learning.ingest.append import Arrival, ObservationLog, follow_rows
from service.storage.database import EventRow, StreamRow

MAX_ROWS = 5000
"""Max rows of one observation batch."""
TIME_UNITS = {"ms": 1e3, "µs": 1e6, "ns": 1e9}
"""Units of time that batches may have by mistake, and how many make a second."""
REUSE_HINT = "use another stream_id for a new run, or higher sequences"
"""Advice at the end of an error message."""


def observe_batch(observed: ObservationLog, model: str, request: ObservationRequest) -> ObservationResponse:
    """Log a batch. It is durable once this returns.

    Raise NotFoundError, InvalidRequestError, ConflictError, ExpiredError, BusyError or StorageFullError.
    """
    served, received = observed.loaded.get(model, None), observed.clocks.date_arrival()
    batch = validate_batch(request, served.model)
    content = compute_digest(batch)
    monitor = observed.monitor(served)
    stream_id, sequence = request.stream_id, request.sequence
    with observed.turn(monitor, model):
        with observed.database.session() as session:
            past = log.read_history(session, model, stream_id, sequence)
            known = find_acknowledgement(session, past, request, content)
            if known is not None:
                monitor.counts["duplicates"] += 1
                return known
            options = owner.read_options(session, model)
            limits = row_limits(served.model, options, observed.settings)
            dated = _date_batch(batch, past, sequence, received, limits, options)
            followed = follow_rows(monitor, served, stream_id, past.source, sequence, dated.rows)
            dated = replace(dated, rows=followed.rows)
            rows, own, derived = _derive_accelerations(session, (model, stream_id, sequence), batch, dated, limits)
        predicted = screening.predict(rows, served, own, carrying=served.payloads.model_for(stream_id))
        entry = NewBatch(
            stream_id,
            "batches",
            sequence,
            sequence,
            content,
            dated.offset,
            received,
            served.version,
            served.revision,
            rows,
        )
        place = Placement((own.start, own.stop), dated.span)
        arrival = Arrival(entry, predicted, past.source is None, place, derived, dated.leap, followed.play)
        answer = observed.append(monitor, served, options, arrival)
    observed.follow_up(monitor, model)
    return answer


def _date_batch(
    batch: MeasuredRows,
    past: StreamHistory,
    sequence: int,
    received: float,
    limits: RowLimits,
    options: LearningOptions,
) -> DatedRows:
    """Date the rows of a new batch by the clock of its stream."""
    below = past.below
    offset = 0.0 if past.source is None else past.source.offset
    adjacent = below is not None and below.last_sequence == sequence - 1
    clock = StreamTime.of(offset, _place(below), _place(past.above), adjacent, received)
    previous = below.last if below is not None and adjacent else None
    return date_rows(batch, clock, limits, previous, options.forgetting_s)


def _derive_accelerations(
    session: Session, key: tuple[str, str, int], batch: MeasuredRows, dated: DatedRows, limits: RowLimits
) -> tuple[Rows, slice, Derivation | None]:
    """Return the rows of a batch, which of them are its own, and how accelerations were derived if none were sent.

    The other rows belong to adjacent batches, whose accelerations this batch completes.
    """
    if batch.ddq is not None or batch.t is None:
        return dated.rows, slice(0, len(batch)), None
    try:
        how = acceleration.Derivation.of(batch.t, log.find_adjacent_window(session, *key))
    except DerivationError as error:
        raise invalid_request(error.field, error.value, error.expected, str(error)) from error
    before, after = (log.read_adjacent_rows(session, *key, way, 2 * how.half) for way in (-1, 1))
    found = acceleration.derive_rows(dated.rows, how, before, after, limits)
    derived = DerivedAcceleration(delay_s=how.delay_s, window=how.half, rate_hz=how.rate, carried=found.carried)
    return found.rows, found.own, Derivation(ddq=derived)


def _place(event: EventRow | None) -> Placement | None:
    return None if event is None or event.report is None else Placement.from_json(event.report)


def row_limits(model: TorqueModel, options: LearningOptions, settings: Settings) -> RowLimits:
    """Return the limits of a row. Torque limits are those of the options, else those of the URDF."""
    torque = None if options.torque_limits is None else np.array(options.torque_limits)
    if torque is None and model.robot is not None:
        effort = np.asarray(model.robot.model.effortLimit, np.float64)[list(model.robot.order)]
        if (effort > 0).all():
            torque = effort
    return RowLimits(
        model.position_limits(settings.max_position),
        settings.max_velocity,
        settings.max_acceleration,
        torque,
    )


def validate_batch(request: ObservationRequest, model: TorqueModel) -> MeasuredRows:
    """Check the shapes and joints of a request and order its columns; raise InvalidRequestError."""
    check_shapes(request, model)
    rows = 1 if request.q.ndim == 1 else len(request.q)
    if rows > MAX_ROWS:
        raise invalid_request("q", f"{rows} rows", f"at most {MAX_ROWS} in one batch")
    if request.t is not None:
        check_times(request, rows)
    if request.t is None and request.ddq is None:
        message = "`ddq` is required unless `t` is given."
        raise invalid_request("ddq", "missing", "accelerations, or times `t` to derive them", message)
    order = slice(None) if request.joint_names is None else find_columns(request.joint_names, model.joint_names)
    q, dq, tau = (_ordered(values, order) for values in (request.q, request.dq, request.tau))
    if request.t is not None:
        _check_time_unit(request.t, q, dq)
    return MeasuredRows(request.t, q, dq, None if request.ddq is None else _ordered(request.ddq, order), tau)


def _check_time_unit(t: Array, q: Array, dq: Array) -> None:
    """Raise InvalidRequestError if positions change with the velocities as if times were not in s."""
    if not all(np.isfinite(values).all() for values in (t, q, dq)):
        return
    ratios = [checks.slope_ratio(t, q[:, joint], dq[:, joint]) for joint in range(q.shape[1])]
    known = [ratio for ratio in ratios if ratio is not None]
    for unit, factor in TIME_UNITS.items():
        if known and abs(float(np.median(known)) / factor - 1) < checks.CHECKS.unit_tolerance:
            step = f"in steps of {np.median(np.diff(t)):g}"
            expected = f"times in s: q changes by dq as if these were {unit}. Multiply them by {1 / factor:g}"
            raise invalid_request("t", step, expected)


def _ordered(values: Array, order: slice | list[int]) -> Array:
    return np.ascontiguousarray(np.atleast_2d(values)[:, order])


def find_columns(given: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Return the index of each of the model's joints in the given names.

    Raise InvalidRequestError if a name is unknown, repeated or missing.
    """
    for index, name in enumerate(given):
        if name not in joints:
            raise invalid_request(f"joint_names[{index}]", name, f"one of the model's joints: {', '.join(joints)}")
        if name in given[:index]:
            field = f"joint_names[{index}]"
            raise invalid_request(field, name, "no joint twice", f"`{field}` repeats joint {name}.")
    if missing := [name for name in joints if name not in given]:
        lacking = ", ".join(missing)
        message = f"`joint_names` lacks {lacking}."
        raise invalid_request("joint_names", f"without {lacking}", "all of the model's joints", message)
    return [given.index(name) for name in joints]


def compute_digest(rows: MeasuredRows) -> str:
    """Return the SHA-256 of shapes and numbers. It does not depend on the JSON or the joint order."""
    content = hashlib.sha256(pack("<2Q", *rows.q.shape))
    for values in (rows.t, rows.q, rows.dq, rows.ddq, rows.tau):
        content.update(b"-" if values is None else b"+")
        if values is not None:
            # there are several bit patterns of zero and NaN
            canonical = np.where(np.isnan(values), np.nan, values + 0.0)
            content.update(canonical.astype("<f8").tobytes())
    return content.hexdigest()


def find_acknowledgement(
    session: Session, past: StreamHistory, request: ObservationRequest, content: str
) -> ObservationResponse | None:
    """Return the first acknowledgement of a batch in the log, with its current state; None for a new batch.

    Raise ConflictError if the log has other content under its sequence, or frames under its stream. Raise ExpiredError
    if the log no longer reaches back to it.
    """
    check_kind(past.source, "batches")
    event = past.same
    if event is None:
        check_not_expired(past.source, request.sequence)
        return None
    if event.digest != content:
        name = f"batch {request.sequence} of stream {request.stream_id!r}"
        raise ConflictError(f"{name} was sent before with other content: {REUSE_HINT}")
    return ObservationResponse.model_validate(
        {**(event.report or {}), "duplicate": True, "state": read_state(session, event)}
    )


def check_not_expired(source: StreamRow | None, sequence: int) -> None:
    """Raise ExpiredError if a batch that is not in the log may have been deleted from it."""
    if source is not None and is_forgotten(source, sequence):
        raise ExpiredError(
            f"it is unknown whether batch {sequence} of stream {source.stream_id!r} was sent before: batches up to "
            f"{source.forgotten} are no longer kept"
        )


def read_state(session: Session, event: EventRow) -> State:
    """Return whether a batch of the log is still learnt and, if not, why."""
    if not event.void:
        return "learnt"
    return "unlearnt" if log.find_related(session, event, "unlearn") else "rolled_back"
