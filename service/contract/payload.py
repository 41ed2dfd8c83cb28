"""Payloads: declared by a query or an owner, and estimated from streams."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from lipcore.vocabulary import PayloadState
from service.contract.body import RequestBody
from service.contract.observations import StreamId


def _three(value: Any) -> Any:
    """Return a list of three items; raise PydanticCustomError for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        raise PydanticCustomError("three", "a list of three")
    return value


MAX_PAYLOAD_NUMBER = 1e6
"""Max size of a payload's numbers in kg, m or kg·m², far beyond any arm's, so that predictions stay finite."""
_VECTOR = {
    "type": "array",
    "items": {"type": "number", "minimum": -MAX_PAYLOAD_NUMBER, "maximum": MAX_PAYLOAD_NUMBER},
    "minItems": 3,
    "maxItems": 3,
}
_MATRIX = {"type": "array", "items": _VECTOR, "minItems": 3, "maxItems": 3}
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_PAYLOAD_NUMBER, le=MAX_PAYLOAD_NUMBER)]
# tuples, so that payloads can be compared; JSON has lists
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_VECTOR)]
Triples = Annotated[
    tuple[Triple, Triple, Triple], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_MATRIX)
]


class Payload(RequestBody):
    """A body on the last link, which the last joint moves, that was not there in training."""

    model_config = ConfigDict(frozen=True)

    mass: Annotated[float, Field(gt=0, le=MAX_PAYLOAD_NUMBER, allow_inf_nan=False)] = Field(
        description="Mass, kg, above zero"
    )
    com: Triple = Field(
        description="Centre of mass in the frame of the last link, m. For a model with a URDF, this is the frame of "
        "the URDF's last movable joint. An arm learnt from torque alone has its own frames, listed in "
        "`parameters.geometry` of the version. Its last frame may differ from the flange, and the arm may be mirrored: "
        "transform a position measured at the flange first"
    )
    inertia: Triples | None = Field(
        None,
        description="Inertia about the centre of mass, along the axes of the last link, 3 × 3, kg·m². By default that "
        "of a point mass",
    )

    @property
    def numbers(self) -> tuple[float, Triple, Triples | None]:
        """Key of the payload in `DeclaredPayloads`."""
        return self.mass, self.com, self.inertia


MAX_DISTANCE_M = 10.0
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-MAX_DISTANCE_M, le=MAX_DISTANCE_M, allow_inf_nan=False)]
Row = Annotated[list[Finite], Field(min_length=3, max_length=3)]
PAYLOAD_EXAMPLE: dict[str, Any] = {"mass": 1.5, "com": [0.0, 0.0, 0.12]}


class PayloadRequest(RequestBody):
    """A payload in the frame of the last link, as in robot controllers."""

    model_config = ConfigDict(json_schema_extra={"examples": [PAYLOAD_EXAMPLE]})

    mass: float = Field(gt=0, le=1000.0, allow_inf_nan=False, description="Mass, kg")
    com: Annotated[list[Metres], Field(min_length=3, max_length=3)] = Field(description="Centre of mass, m")
    inertia: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = Field(
        None,
        description="Inertia about the centre of mass, along the axes of the link, 3 × 3, kg·m²; null: a point mass",
    )
    stream_id: StreamId | None = Field(
        None, description="Stream of the robot that carries it; null: all robots of the model"
    )


class Scalar(BaseModel):
    """A number and its standard deviation."""

    mean: float
    std: float


class Vector(BaseModel):
    """Three numbers and their standard deviations."""

    mean: list[float]
    std: list[float]


class Tensor(BaseModel):
    """A 3 × 3 matrix and its standard deviations."""

    mean: list[list[float]]
    std: list[list[float]]


class PayloadBody(BaseModel):
    """Estimate of a body on the last link."""

    mass: Scalar = Field(description="Mass, kg")
    com: Vector = Field(description="Centre of mass in the frame of the last link, m")
    com_tip: Vector | None = Field(description="Centre of mass in the frame of the URDF's tip, m; null without a URDF")
    inertia: Tensor = Field(description="Inertia about the centre of mass, along the axes of the last link, kg·m²")


class Carrying(BaseModel):
    """Payload state of one robot."""

    stream_id: str
    state: PayloadState = Field(
        description="State by the latest rows: `payload`, `contact`, `friction` (changed friction) or `none`"
    )
    declared: bool = Field(description="Whether the payload was declared rather than detected")
    since: str | None = Field(description="Time since which the robot carries this payload, or none")
    rows: int = Field(description="Rows used to estimate the payload")


class LivePayload(Carrying):
    """Short summary of one robot's payload."""

    mass: Scalar | None = Field(description="Mass, kg; null without a payload")


class StreamPayload(Carrying):
    """Payload of one robot."""

    probabilities: dict[str, float] = Field(
        description="Probabilities of events that may have begun within the last 0.3 s"
    )
    payload: PayloadBody | None = Field(description="Null: nothing beyond what the model was trained with")


class Payloads(BaseModel):
    """Payloads of a model's robots."""

    model: str
    version: int
    link: str | None = Field(description="Joint that moves the last link")
    frame: Literal["learnt", "urdf"] | None = Field(
        description="Frame of the centres of mass. `urdf`: of the URDF's link. `learnt`: the arm was learnt from "
        "torque alone; the origin lies on the last joint's axis, and lengths and masses are as accurate as the geometry"
    )
    tip: str | None = Field(description="Frame of the URDF that is its tip")
    reason: str | None = Field(description="Why payloads are not detected; null if they are")
    streams: list[StreamPayload]
    default: PayloadBody | None = Field(
        description="Payload declared for all robots of the model. It applies to streams without observations"
    )
