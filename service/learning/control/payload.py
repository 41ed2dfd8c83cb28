"""What arms carry: shown for each stream of a model, declared by its owner, and said to be gone."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lipcore.data.samples import Array
from lipcore.model.payload import Body
from lipcore.online.holding import State, Watch
from lipcore.online.payload import body
from lipcore.robots.urdf import RigidBody
from service.foundation.errors import ConflictError, invalid_request
from service.journal import log
from service.learning import owner
from service.learning.learners import Learners
from service.learning.schema import StreamId

DRAWS = 500
"""Of a payload's parameters, for the spread of its figures."""
MOST_MASS, MOST_DISTANCE = 1000.0, 10.0
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-MOST_DISTANCE, le=MOST_DISTANCE, allow_inf_nan=False)]
Row = Annotated[list[Finite], Field(min_length=3, max_length=3)]
EXAMPLE: dict[str, Any] = {"mass": 1.5, "com": [0.0, 0.0, 0.12]}


class PayloadRequest(BaseModel):
    """A payload that the arm carries, as robot controllers take it: in the frame of the last link."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [EXAMPLE]})

    mass: float = Field(gt=0, le=MOST_MASS, allow_inf_nan=False, description="kg")
    com: Annotated[list[Metres], Field(min_length=3, max_length=3)] = Field(description="Centre of mass, m")
    inertia: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = Field(
        None, description="3 × 3 about the centre of mass, along the axes of the link, kg·m²; null: that of a point"
    )
    stream_id: StreamId | None = Field(None, description="The robot that carries it; null: all of the model")


class Scalar(BaseModel):
    """A number and its standard deviation."""

    mean: float
    std: float


class Vector(BaseModel):
    """Three numbers and their standard deviations."""

    mean: list[float]
    std: list[float]


class Tensor(BaseModel):
    """A matrix of 3 × 3 and its standard deviations."""

    mean: list[list[float]]
    std: list[list[float]]


class PayloadBody(BaseModel):
    """A body on the last link, as far as its stream tells."""

    mass: Scalar = Field(description="kg")
    com: Vector = Field(description="Centre of mass in the frame of the last link, m")
    com_tip: Vector | None = Field(description="The same in the frame of the URDF's tip, m; null without a URDF")
    inertia: Tensor = Field(description="About the centre of mass, along the axes of the last link, kg·m²")


class StreamPayload(BaseModel):
    """What one robot carries."""

    stream_id: str
    state: State = Field(
        description="What its last rows show: `payload`, `contact`, `friction` (it has changed), or `none` of these"
    )
    declared: bool = Field(description="Whether the payload was declared, and not only seen")
    since: str | None = Field(description="Since when it carries what it carries, or nothing")
    rows: int = Field(description="Rows that the payload was seen on")
    probabilities: dict[str, float] = Field(description="Of what may have begun within the last 0.3 s")
    payload: PayloadBody | None = Field(description="null: it carries nothing that the model was not trained with")


class Payloads(BaseModel):
    """What the robots of a model carry."""

    model: str
    version: int
    link: str | None = Field(description="The joint that moves the last link")
    frame: Literal["learnt", "urdf"] | None = Field(
        description="Whose frame of that link centres of mass are in. `learnt`: the arm was learnt from torque alone; "
        "its origin lies on the last joint's axis, and lengths, and with them masses, are as good as the geometry"
    )
    tip: str | None = Field(description="The frame of the URDF that counts as its tip")
    reason: str | None = Field(description="Why nothing is watched; null where payloads are")
    streams: list[StreamPayload]


def show(learners: Learners, model: str) -> Payloads:
    """What the arm carries, stream by stream; raise NotFoundError."""
    monitor = learners.monitor(model)
    served = learners.loaded.get(model, None)
    streams, carrier = [], served.carrier
    tip = None if served.model.robot is None else _tip(served.model.robot)
    if carrier is not None:
        for stream_id, (watch, _) in sorted(monitor.payloads.all(carrier, served.version).items()):
            streams.append(_shown(stream_id, watch, tip))
    with learners.database.session() as session:
        watched = owner.options(session, model).payloads
    reason = None
    if carrier is None:
        reason = f"estimator {served.model.estimator.name} knows no arm: train rigid-body, rigid-body+lip-chain or auto"
    elif not watched:
        reason = "the option `payloads` of learning is switched off"
    return Payloads(
        model=model,
        version=served.version,
        link=None if carrier is None else served.model.joint_names[int(carrier.term.arm.order[-1])],
        frame=None if carrier is None else ("learnt" if carrier.term.arm.mode == "learn" else "urdf"),
        tip=None if tip is None else tip[0],
        reason=reason,
        streams=streams,
    )


def declare(learners: Learners, model: str, request: PayloadRequest) -> Payloads:
    """Say what an arm carries from now on; raise NotFoundError, InvalidRequestError or ConflictError."""
    inertia = None if request.inertia is None else np.array(request.inertia)
    try:
        Body(request.mass, np.array(request.com), inertia)
    except ValueError as error:
        raise invalid_request("inertia", request.inertia, f"that of a body which can exist: {error}") from error
    known = {"mass": request.mass, "com": request.com, "inertia": request.inertia}
    return _say(learners, model, request.stream_id, known)


def remove(learners: Learners, model: str, stream_id: str | None) -> Payloads:
    """Say that an arm carries nothing from now on; raise NotFoundError or ConflictError."""
    return _say(learners, model, stream_id, None)


def _say(learners: Learners, model: str, stream_id: str | None, known: dict[str, Any] | None) -> Payloads:
    served = learners.loaded.get(model, None)
    if served.carrier is None:
        raise ConflictError(
            f"version {served.version} of model {model!r}, estimator {served.model.estimator.name}, knows no arm that "
            "could carry anything: train rigid-body, rigid-body+lip-chain or auto"
        )
    monitor = learners.monitor(model)
    with learners.turn(model):
        with learners.database.transaction(model) as session:
            event = log.append(session, model, "payload", {"stream_id": stream_id, "body": known}, time.time())
        monitor.declared(event)
        served.loads.take(monitor.payloads.carried(served.carrier, served.version))
    learners.process.wake(model)
    return show(learners, model)


def _tip(robot: RigidBody) -> tuple[str, Array, Array] | None:
    """Name, rotation and place of the last frame of a URDF in that of its last movable joint."""
    model = robot.model
    own = [each for each in model.frames if each.parentJoint == model.njoints - 1]
    if not own:
        return None
    return own[-1].name, np.array(own[-1].placement.rotation), np.array(own[-1].placement.translation)


def _shown(stream_id: str, watch: Watch, tip: tuple[str, Array, Array] | None) -> StreamPayload:
    """One stream's payload for JSON."""
    held = watch.held
    return StreamPayload(
        stream_id=stream_id,
        state=watch.state,
        declared=held is not None and held.declared,
        since=None
        if watch.since is None
        else datetime.fromtimestamp(watch.since, UTC).isoformat(timespec="milliseconds"),
        rows=0 if held is None else held.count,
        probabilities=dict(watch.probabilities or {"none": 1.0}),
        payload=None if held is None else _of(held.estimate.eta, held.estimate.covariance, tip),
    )


def _of(eta: Array, covariance: Array, tip: tuple[str, Array, Array] | None) -> PayloadBody:
    """Mean and deviation of a payload's figures: of its parameters' distribution, by draws from it, seeded."""
    draws = np.random.default_rng(0).multivariate_normal(eta, covariance, DRAWS)
    every = [Body.of(body(each)[0]) for each in draws]
    best = Body.of(body(eta)[0])

    def figure(mean: Any, values: list[Any]) -> dict[str, Any]:
        return {"mean": np.asarray(mean).tolist(), "std": np.std(values, axis=0).tolist()}

    at_tip = None
    if tip is not None:
        _, turn, place = tip
        at_tip = Vector(**figure(turn.T @ (best.com - place), [turn.T @ (each.com - place) for each in every]))
    return PayloadBody(
        mass=Scalar(**figure(best.mass, [each.mass for each in every])),
        com=Vector(**figure(best.com, [each.com for each in every])),
        com_tip=at_tip,
        inertia=Tensor(**figure(best.inertia, [each.inertia for each in every])),
    )
