"""A batch on its way into the log: in the model's joint order, known again if repeated, checked, predicted, judged."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from struct import pack

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.model.torque_model import TorqueModel
from service.foundation.errors import ConflictError, invalid_request
from service.foundation.settings import Settings
from service.journal import log
from service.learning.ingest import screening
from service.learning.ingest.intake import Arrival, Intake, check_kind, enabled
from service.learning.ingest.monitor import Monitor
from service.learning.ingest.screening import Clock, Measured
from service.learning.schema import Derivation, ExpiredError, ObservationRequest, ObservationResponse, State
from service.models.loaded import Served
from service.storage.database import EventRow


def observe_batch(intake: Intake, model: str, request: ObservationRequest) -> ObservationResponse:
    """Take a batch; once this returns it is durable.

    Raise NotFoundError, LearningDisabledError, InvalidRequestError, ConflictError, ExpiredError, BusyError or
    StorageFullError.
    """
    served, received = intake.loaded.get(model, None), time.time()
    batch = measured(request, served.model, intake.settings)
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
        options, source = enabled(session, model), log.stream(session, model, stream_id)
        check_kind(source, "batches")
        answer = acknowledged(session, *key, content)
        if answer is not None:
            monitor.counts["duplicates"] += 1
            return answer
        bounds = screening.limits(served.model, options, intake.settings)
        before, after = log.neighbours(session, *key)
        clock = Clock.of(source, sequence, before, after, received)
        previous = before.last if before is not None and clock.adjacent else None
        dated = screening.dated(batch, clock, bounds, previous)
        rows, own, derived = dated.rows, slice(0, len(batch)), None
        if batch.ddq is None and batch.t is not None:
            rows, own, derived = screening.derive(session, *key, rows, batch.t, bounds)
    screened = screening.predict(rows, own, derived, served.model)
    arrival = Arrival(stream_id, "batches", sequence, sequence, content, len(batch), dated.offset, dated.span, received)
    details = {"derived": None if derived is None else Derivation(ddq=derived).model_dump()}
    return ObservationResponse.model_validate(intake.append(monitor, served, options, arrival, screened, details))


def measured(request: ObservationRequest, model: TorqueModel, settings: Settings) -> Measured:
    """Check a request's shapes and joints and bring its columns in order; raise InvalidRequestError."""
    shape = request.q.shape
    for name in ("q", "dq", "ddq", "tau"):
        values = getattr(request, name)
        if values is None:
            continue
        if values.shape[-1] != model.n_joints:
            expected = f"{model.n_joints} numbers: {', '.join(model.joint_names)}"
            raise invalid_request(name, f"{values.shape[-1]} numbers long", expected)
        if values.shape != shape:
            raise invalid_request(name, f"of shape {values.shape}", f"the shape of q, {shape}")
    rows = 1 if request.q.ndim == 1 else len(request.q)
    if rows > settings.max_observation_rows:
        raise invalid_request("q", f"{rows} rows", f"at most {settings.max_observation_rows} in one batch")
    if request.t is not None and request.t.shape != (rows,):
        raise invalid_request("t", f"{len(request.t)} numbers long", f"{rows}, one a row of q")
    if request.t is None and request.ddq is None:
        raise invalid_request("ddq", "missing, and t too", "accelerations, or times to derive them from dq with")
    order = slice(None) if request.joint_names is None else columns(request.joint_names, model.joint_names)
    q, dq, ddq, tau = (
        None if values is None else np.ascontiguousarray(np.atleast_2d(values)[:, order])
        for values in (request.q, request.dq, request.ddq, request.tau)
    )
    assert q is not None
    assert dq is not None
    assert tau is not None
    return Measured(request.t, q, dq, ddq, tau)


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
        raise ConflictError(
            f"batch {sequence} of stream {stream_id!r} has come before with other content: a sequence is used once"
        )
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
    query = select(EventRow.seq).where(
        EventRow.model == event.model,
        EventRow.number > event.number,
        EventRow.kind == "unlearn",
        EventRow.detail["event"].as_integer() == event.number,
    )
    return "rolled_back" if session.scalar(query.limit(1)) is None else "unlearnt"
