"""Payloads: what a query or an owner declares, and what is known of what arms carry."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema
from pydantic_core import PydanticCustomError

from lipcore.vocabulary import PayloadState
from service.contract.observations import StreamId


def _three(value: Any) -> Any:
    """A list of three of whatever; raise PydanticCustomError for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        raise PydanticCustomError("three", "a list of three")
    return value


MOST_NUMBER = 1e6
"""Largest number of a payload in kg, m or kg·m², far beyond any arm's: what is answered stays a number."""
_VECTOR = {
    "type": "array",
    "items": {"type": "number", "minimum": -MOST_NUMBER, "maximum": MOST_NUMBER},
    "minItems": 3,
    "maxItems": 3,
}
_MATRIX = {"type": "array", "items": _VECTOR, "minItems": 3, "maxItems": 3}
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MOST_NUMBER, le=MOST_NUMBER)]
# tuples, so that payloads can be compared; of JSON they are lists
Triple = Annotated[tuple[Number, Number, Number], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_VECTOR)]
Triples = Annotated[
    tuple[Triple, Triple, Triple], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_MATRIX)
]


class Payload(BaseModel):
    """A body that the arm carries besides what it was learnt with, fixed to its last link: the one that the last joint
    moves."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    mass: Annotated[float, Field(gt=0, le=MOST_NUMBER, allow_inf_nan=False)] = Field(description="kg, above zero")
    com: Triple = Field(
        description="Centre of mass, m, in the frame of the last link. Of a model around a URDF that is the frame of "
        "the URDF's last movable joint. An arm that was learnt from torque alone has frames of its own, which "
        "`parameters.geometry` of the version lists. Its last one need not lie at the flange or point as it does, and "
        "the arm may be mirrored: bring a position measured at the flange into that frame first"
    )
    inertia: Triples | None = Field(
        None,
        description="3 × 3, kg·m², about the centre of mass, along the axes of the last link; that of a point where it "
        "is left out",
    )

    @property
    def numbers(self) -> tuple[float, Triple, Triples | None]:
        """What `DeclaredPayloads` knows it by."""
        return self.mass, self.com, self.inertia


MOST_DISTANCE = 10.0
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-MOST_DISTANCE, le=MOST_DISTANCE, allow_inf_nan=False)]
Row = Annotated[list[Finite], Field(min_length=3, max_length=3)]
PAYLOAD_EXAMPLE: dict[str, Any] = {"mass": 1.5, "com": [0.0, 0.0, 0.12]}


class PayloadRequest(BaseModel):
    """A payload that the arm carries, as robot controllers take it: in the frame of the last link."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [PAYLOAD_EXAMPLE]})

    mass: float = Field(gt=0, le=1000.0, allow_inf_nan=False, description="kg")
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


class Carrying(BaseModel):
    """Whether one robot carries anything."""

    stream_id: str
    state: PayloadState = Field(
        description="What its last rows show: `payload`, `contact`, `friction` (it has changed), or `none` of these"
    )
    declared: bool = Field(description="Whether the payload was declared, and not only seen")
    since: str | None = Field(description="Since when it carries what it carries, or nothing")
    rows: int = Field(description="Rows that the payload was seen on")


class LivePayload(Carrying):
    """What one robot carries, in short."""

    mass: Scalar | None = Field(description="kg; null: nothing that the model was not trained with")


class StreamPayload(Carrying):
    """What one robot carries."""

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
    default: PayloadBody | None = Field(
        description="Declared for all of the model: what streams that have sent nothing yet are answered with"
    )
