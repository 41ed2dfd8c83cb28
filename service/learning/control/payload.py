"""Payloads of a model's streams: read, declared and removed."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.model.body import Body
from lipcore.model.payload import ONE_ARM, Carrier
from lipcore.online.payload.bodies import BELOW, DIAGONAL
from lipcore.online.payload.estimate import Estimate
from lipcore.online.payload.holding import PayloadTracker
from lipcore.online.stream import PayloadRecord
from lipcore.robots.urdf import RigidBody
from service.contract.payload import (
    LivePayload,
    PayloadBody,
    PayloadRequest,
    Payloads,
    Scalar,
    StreamPayload,
    Tensor,
    Vector,
)
from service.foundation.errors import ConflictError, NotFoundError, invalid_request, problem
from service.journal import log
from service.learning import owner
from service.learning.ingest.monitor import Monitor
from service.learning.learners import Learners
from service.models.served import ServedModel
from service.storage import audit
from service.storage.database import iso_time

INERTIA_DRAWS = 500
"""Draws of a payload's parameters for the standard deviation of its inertia."""
Tip = tuple[str, Array, Array]
"""Name, rotation (3, 3) and position (3,) of the tip's frame."""


def read_payloads(learners: Learners, model: str) -> Payloads:
    """Return the payload of each stream; raise NotFoundError."""
    monitor = learners.monitor(model)
    served = learners.loaded.get(model, None)
    streams, default, carrier = list[StreamPayload](), None, served.carrier
    tip = None if served.model.robot is None else _tip(served.model.robot)
    with learners.database.session() as session:
        watched = owner.read_options(session, model).payloads
    if carrier is not None:
        known = _watches(monitor, carrier, served.version)
        streams = [_stream_payload(name, watch, tip) for name, watch in known if watched or watch.held is not None]
        held = monitor.payloads.watch("", carrier, served.version).held  # "" is the name of the default
        default = None if held is None else _payload_body(held.estimate, tip)
    reason = None
    if carrier is None:
        reason = _reason_without_carrier(served)
    elif not watched:
        reason = "the learning option `payloads` is off"
    return Payloads(
        model=model,
        version=served.version,
        link=None if carrier is None else served.model.joint_names[int(carrier.term.arm.order[-1])],
        frame=None if carrier is None else ("learnt" if carrier.term.arm.mode == "learn" else "urdf"),
        tip=None if tip is None else tip[0],
        reason=reason,
        streams=streams,
        default=default,
    )


def summarise_payloads(monitor: Monitor, served: ServedModel) -> list[LivePayload] | None:
    """Return the payload of each stream as a version sees it; None if the version has no arm."""
    if served.carrier is None:
        return None
    watches = _watches(monitor, served.carrier, served.version)
    return [LivePayload(**_carrying_fields(name, watch), mass=_mass(watch)) for name, watch in watches]


def declare(learners: Learners, model: str, request: PayloadRequest) -> Payloads:
    """Declare the payload of a stream, or of all, from now on.

    Raise NotFoundError, also for an unknown stream, InvalidRequestError or ConflictError.
    """
    inertia = None if request.inertia is None else np.array(request.inertia)
    try:
        with np.errstate(over="raise", invalid="raise"):  # sums of huge numbers overflow
            Body(request.mass, np.array(request.com), inertia)
    except (ValueError, FloatingPointError) as error:
        message = f"No body has this mass and inertia: {error}."
        raise invalid_request("inertia", request.inertia, "the inertia of a possible body", message) from error
    known = {"mass": request.mass, "com": request.com, "inertia": request.inertia}
    return _declare(learners, model, request.stream_id, known)


def remove(learners: Learners, model: str, stream_id: str | None) -> Payloads:
    """Declare that there is no payload from now on; raise NotFoundError or ConflictError."""
    return _declare(learners, model, stream_id, None)


def _reason_without_carrier(served: ServedModel) -> str:
    if served.model.arms:
        return f"it has {served.model.arms} arms, {ONE_ARM}"
    return f"estimator {served.model.estimator.name} has no arm: train with rigid-body or auto"


def _declare(learners: Learners, model: str, stream_id: str | None, known: dict[str, Any] | None) -> Payloads:
    served = learners.loaded.get(model, None)
    if served.carrier is None:
        raise ConflictError(
            f"version {served.version} of model {model!r} cannot have a payload: {_reason_without_carrier(served)}"
        )
    monitor = learners.monitor(model)
    with learners.turn(model):
        with learners.database.transaction(model) as session:
            source = None if stream_id is None else log.stream(session, model, stream_id)
            if stream_id is not None and source is None:
                expected = "a stream that has sent observations, or no stream_id to declare it for all streams"
                raise NotFoundError(f"no stream {stream_id!r}", [problem("stream_id", stream_id, expected)])
            declared, received = {"stream_id": stream_id, "body": known}, time.time()
            event = log.append(session, model, "payload", declared, received)
            payload = PayloadRecord(event.number, received, body=known)
            if source is None:
                owner.store_payload(session, model, payload.to_json())
            else:
                event.stream_id = stream_id
                source.record = replace(monitor.streams.get(source.stream_id), payload=payload).to_json()
            audit.note(session, model, "payload declared", served.version, after=declared)
        if stream_id is None:
            monitor.streams.default = payload
        else:
            monitor.streams.change(stream_id, payload=payload)
        monitor.number = event.number
        served.payloads.replace(monitor.payloads.build_models(served.carrier, served.version))
    learners.process.wake(model)
    return read_payloads(learners, model)


def _watches(monitor: Monitor, carrier: Carrier, version: int) -> list[tuple[str, PayloadTracker]]:
    """Return the payload of each stream as a version sees it."""
    return [(name, monitor.payloads.watch(name, carrier, version)) for name in sorted(monitor.streams.all())]


def _tip(robot: RigidBody) -> Tip | None:
    """Return the last frame of a URDF relative to its last movable joint; None if that has no frame."""
    model = robot.model
    own = [each for each in model.frames if each.parentJoint == model.njoints - 1]
    if not own:
        return None
    return own[-1].name, np.array(own[-1].placement.rotation), np.array(own[-1].placement.translation)


def _carrying_fields(stream_id: str, watch: PayloadTracker) -> dict[str, Any]:
    """Return the fields of `Carrying`."""
    held, since = watch.held, watch.since
    return {
        "stream_id": stream_id,
        "state": watch.state,
        "declared": held is not None and held.declared,
        "since": None if since is None else iso_time(since),
        "rows": 0 if held is None else held.count,
    }


def _mass(watch: PayloadTracker) -> Scalar | None:
    if watch.held is None:
        return None
    mean, std = watch.held.estimate.mass
    return Scalar(mean=mean, std=std)


def _stream_payload(stream_id: str, watch: PayloadTracker, tip: Tip | None) -> StreamPayload:
    """Return one stream's payload for JSON."""
    return StreamPayload(
        **_carrying_fields(stream_id, watch),
        probabilities=dict(watch.probabilities or {"none": 1.0}),
        payload=None if watch.held is None else _payload_body(watch.held.estimate, tip),
    )


def _payload_body(found: Estimate, tip: Tip | None) -> PayloadBody:
    """Return the mean and standard deviation of a payload's figures. The std of the inertia comes from random draws."""
    mass, std = found.mass
    com, spread = found.eta[1:4], found.covariance[1:4, 1:4]
    drawn = np.random.default_rng(0).multivariate_normal(found.eta, found.covariance, INERTIA_DRAWS)
    return PayloadBody(
        mass=Scalar(mean=mass, std=std),
        com=_vector(com, spread),
        com_tip=None if tip is None else _vector(tip[1].T @ (com - tip[2]), tip[1].T @ spread @ tip[1]),
        inertia=Tensor(mean=_inertias(found.eta[None])[0].tolist(), std=_inertias(drawn).std(axis=0).tolist()),
    )


def _vector(mean: Array, covariance: Array) -> Vector:
    return Vector(mean=mean.tolist(), std=np.sqrt(np.diag(covariance)).tolist())


def _inertias(eta: Array) -> Array:
    """Return the inertias about the centre of mass, (N, 3, 3), of parameters η, (N, 10)."""
    root = np.zeros((len(eta), 3, 3))
    root[:, *DIAGONAL], root[:, *BELOW] = np.exp(eta[:, 4:7]), eta[:, 7:]
    second = np.exp(eta[:, 0])[:, None, None] * (root @ root.transpose(0, 2, 1))
    inertias: Array = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return inertias
