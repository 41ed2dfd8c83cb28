"""A payload that a query declares, as the API takes it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema
from pydantic_core import PydanticCustomError


def _three(value: Any) -> Any:
    """A list of three of whatever; raise PydanticCustomError for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        raise PydanticCustomError("three", "a list of three")
    return value


MOST = 1e6
"""Largest number of a payload in kg, m or kg·m², far beyond any arm's: what is answered stays a number."""
_VECTOR = {
    "type": "array",
    "items": {"type": "number", "minimum": -MOST, "maximum": MOST},
    "minItems": 3,
    "maxItems": 3,
}
_MATRIX = {"type": "array", "items": _VECTOR, "minItems": 3, "maxItems": 3}
Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MOST, le=MOST)]
# tuples, so that payloads can be compared; of JSON they are lists
Vector = Annotated[tuple[Number, Number, Number], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_VECTOR)]
Matrix = Annotated[tuple[Vector, Vector, Vector], Field(strict=False), BeforeValidator(_three), WithJsonSchema(_MATRIX)]


class Payload(BaseModel):
    """A body that the arm carries besides what it was learnt with, fixed to its last link: the one that the last joint
    moves."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    mass: Annotated[float, Field(gt=0, le=MOST, allow_inf_nan=False)] = Field(description="kg, above zero")
    com: Vector = Field(
        description="Centre of mass, m, in the frame of the last link. Of a model around a URDF that is the frame of "
        "the URDF's last movable joint. An arm that was learnt from torque alone has frames of its own, which "
        "`parameters.geometry` of the version lists. Its last one need not lie at the flange or point as it does, and "
        "the arm may be mirrored: bring a position measured at the flange into that frame first"
    )
    inertia: Matrix | None = Field(
        None,
        description="3 × 3, kg·m², about the centre of mass, along the axes of the last link; that of a point where it "
        "is left out",
    )

    @property
    def numbers(self) -> tuple[float, Vector, Matrix | None]:
        """What `Declared` knows it by."""
        return self.mass, self.com, self.inertia
