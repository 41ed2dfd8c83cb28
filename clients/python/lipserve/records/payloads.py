"""What arms carry. Written by `python clients/python/records.py`."""

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
    """A matrix of 3 × 3 and its standard deviations."""

    mean: list[list[float]]
    std: list[list[float]]


class PayloadBody(Record, frozen=True, kw_only=True):
    """A body on the last link, as far as its stream tells.

    mass: kg
    com: Centre of mass in the frame of the last link, m
    com_tip: The same in the frame of the URDF's tip, m; null without a URDF
    inertia: About the centre of mass, along the axes of the last link, kg·m²
    """

    mass: Scalar
    com: Vector
    com_tip: Vector | None
    inertia: Tensor


class StreamPayload(Record, frozen=True, kw_only=True):
    """What one robot carries.

    state: What its last rows show: `payload`, `contact`, `friction` (it has changed), or `none` of these
    declared: Whether the payload was declared, and not only seen
    since: Since when it carries what it carries, or nothing
    rows: Rows that the payload was seen on
    probabilities: Of what may have begun within the last 0.3 s
    payload: null: it carries nothing that the model was not trained with
    """

    stream_id: str
    state: Literal["none", "payload", "contact", "friction"]
    declared: bool
    since: str | None
    rows: int
    probabilities: dict[str, float]
    payload: PayloadBody | None


class Payloads(Record, frozen=True, kw_only=True):
    """What the robots of a model carry.

    link: The joint that moves the last link
    frame: Whose frame of that link centres of mass are in. `learnt`: the arm was learnt from torque alone; its origin
        lies on the last joint's axis, and lengths, and with them masses, are as good as the geometry
    tip: The frame of the URDF that counts as its tip
    reason: Why nothing is watched; null where payloads are
    default: Declared for all of the model: what streams that have sent nothing yet are answered with
    """

    model: str
    version: int
    link: str | None
    frame: Literal["learnt", "urdf"] | None
    tip: str | None
    reason: str | None
    streams: list[StreamPayload]
    default: PayloadBody | None
