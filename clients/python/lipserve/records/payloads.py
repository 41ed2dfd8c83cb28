"""Payloads. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record


class Scalar(Record, frozen=True, kw_only=True):
    """A number and its standard deviation."""

    mean: float
    std: float


class Vector(Record, frozen=True, kw_only=True):
    """Three numbers and their standard deviations."""

    mean: list[float]
    std: list[float]


class Tensor(Record, frozen=True, kw_only=True):
    """A 3 × 3 matrix and its standard deviations."""

    mean: list[list[float]]
    std: list[list[float]]


class PayloadBody(Record, frozen=True, kw_only=True):
    """Estimate of a body on the last link.

    mass: Mass, kg
    com: Centre of mass in the frame of the last link, m
    com_tip: Centre of mass in the frame of the URDF's tip, m; null without a URDF
    inertia: Inertia about the centre of mass, along the axes of the last link, kg·m²
    """

    mass: Scalar
    com: Vector
    com_tip: Vector | None
    inertia: Tensor


class StreamPayload(Record, frozen=True, kw_only=True):
    """Payload of one robot.

    state: State by the latest rows: `payload`, `contact`, `friction` (changed friction) or `none`
    declared: Whether the payload was declared rather than detected
    since: Time since which the robot carries this payload, or none
    rows: Rows used to estimate the payload
    probabilities: Probabilities of events that may have begun within the last 0.3 s
    payload: Null: nothing beyond what the model was trained with
    """

    stream_id: str
    state: Literal["none", "payload", "contact", "friction"]
    declared: bool
    since: str | None
    rows: int
    probabilities: dict[str, float]
    payload: PayloadBody | None


class Payloads(Record, frozen=True, kw_only=True):
    """Payloads of a model's robots.

    link: Joint that moves the last link
    frame: Frame of the centres of mass. `urdf`: of the URDF's link. `learnt`: the arm was learnt from torque alone; the
        origin lies on the last joint's axis, and lengths and masses are as accurate as the geometry
    tip: Frame of the URDF that is its tip
    reason: Why payloads are not detected; null if they are
    default: Payload declared for all robots of the model. It applies to streams without observations
    """

    model: str
    version: int
    link: str | None
    frame: Literal["learnt", "urdf"] | None
    tip: str | None
    reason: str | None
    streams: list[StreamPayload]
    default: PayloadBody | None
