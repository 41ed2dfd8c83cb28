"""A batch on its way into the log: in the model's joint order, recognised if repeated, dated and predicted."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from struct import pack

import numpy as np
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online import acceleration, screening
from lipcore.online.acceleration import DerivationError
from lipcore.online.batch import Placement, Rows
from lipcore.online.dating import Dated, Measured, StreamTime, date_rows
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
from service.foundation.errors import ConflictError, invalid_request
from service.foundation.settings import Settings
from service.inference.predicting import check_shapes
from service.journal import log
from service.journal.arrivals import NewBatch, check_kind, is_forgotten
from service.journal.log import Past
from service.learning import owner
from service.learning.ingest.append import Arrival, ObservationLog
from service.storage.database import EventRow, StreamRow

MAX_ROWS = 5000
"""Rows of one observation batch."""
ONCE = "a sequence is used once, so a new run needs a stream_id of its own, or higher sequences"


def observe_batch(observed: ObservationLog, model: str, request: ObservationRequest) -> ObservationResponse:
    """Log a batch; once this returns it is durable. Raise NotFoundError, InvalidRequestError, ConflictError,
    ExpiredError, BusyError or StorageFullError."""
    served, received = observed.loaded.get(model, None), observed.clocks.arrival()
    batch = validated(request, served.model)
    content = digest(batch)
    monitor = observed.monitor(served)
    stream_id, sequence = request.stream_id, request.sequence
    with observed.turn(monitor, model):
        with observed.database.session() as session:
            past = log.past(session, model, stream_id, sequence)
            known = acknowledged(session, past, request, content)
            if known is not None:
                monitor.counts["duplicates"] += 1
                return known
            options = owner.options(session, model)
            limits = row_limits(served.model, options, observed.settings)
            dated = _dated(batch, past, sequence, received, limits, options)
            rows, own, derived = _complete(session, (model, stream_id, sequence), batch, dated, limits)
        predicted = screening.predict(rows, served, own, carrying=served.loads.of(stream_id))
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
        arrival = Arrival(entry, predicted, past.source is None, place, derived, dated.leap)
        answer = observed.append(monitor, served, options, arrival)
    observed.follow_up(monitor, model)
    return answer


def _dated(
    batch: Measured, past: Past, sequence: int, received: float, limits: RowLimits, options: LearningOptions
) -> Dated:
    """Date the rows of a new batch by the clock of its stream."""
    below = past.below
    offset = 0.0 if past.source is None else past.source.offset
    adjacent = below is not None and below.last_sequence == sequence - 1
    clock = StreamTime.of(offset, _place(below), _place(past.above), adjacent, received)
    previous = below.last if below is not None and adjacent else None
    return date_rows(batch, clock, limits, previous, options.forgetting_s)


def _complete(
    session: Session, key: tuple[str, str, int], batch: Measured, dated: Dated, limits: RowLimits
) -> tuple[Rows, slice, Derivation | None]:
    """The rows of a batch, with derived accelerations if none were sent; those of others that it completes; which are
    its own; and how they were derived."""
    if batch.ddq is not None or batch.t is None:
        return dated.rows, slice(0, len(batch)), None
    try:
        how = acceleration.Derivation.of(batch.t, log.derived_beside(session, *key))
    except DerivationError as error:
        raise invalid_request(error.field, error.value, error.expected) from error
    before, after = (log.rows_beside(session, *key, way, 2 * how.half) for way in (-1, 1))
    found = acceleration.derive_rows(dated.rows, how, before, after, limits)
    told = DerivedAcceleration(delay_s=how.delay_s, window=how.half, rate_hz=how.rate, carried=found.carried)
    return found.rows, found.own, Derivation(ddq=told)


def _place(event: EventRow | None) -> Placement | None:
    return None if event is None or event.report is None else Placement.from_json(event.report)


def row_limits(model: TorqueModel, options: LearningOptions, settings: Settings) -> RowLimits:
    """What a row of a model may hold: its actuators' limits are those of its options, else those of its URDF."""
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


def validated(request: ObservationRequest, model: TorqueModel) -> Measured:
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


def acknowledged(session: Session, past: Past, request: ObservationRequest, content: str) -> ObservationResponse | None:
    """The first acknowledgement of a batch that is in the log, with its state now; None for one that is new.

    Raise ConflictError where the log has another content under its sequence, or frames under its stream; ExpiredError
    where the log no longer reaches back to it.
    """
    check_kind(past.source, "batches")
    event = past.same
    if event is None:
        check_kept(past.source, request.sequence)
        return None
    if event.digest != content:
        name = f"batch {request.sequence} of stream {request.stream_id!r}"
        raise ConflictError(f"{name} has come before with other content: {ONCE}")
    return ObservationResponse.model_validate(
        {**(event.report or {}), "duplicate": True, "state": state(session, event)}
    )


def check_kept(source: StreamRow | None, sequence: int) -> None:
    """Raise ExpiredError where a batch that is not in the log may have been there."""
    if source is not None and is_forgotten(source, sequence):
        raise ExpiredError(
            f"it is not known any more whether batch {sequence} of stream {source.stream_id!r} has come before: "
            f"batches up to {source.forgotten} are no longer kept"
        )


def state(session: Session, event: EventRow) -> State:
    """Whether a batch of the log still teaches, and if not, why."""
    if not event.void:
        return "learnt"
    return "unlearnt" if log.about(session, event, "unlearn") else "rolled_back"
