"""Torque queries and answers."""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from lipcore.vocabulary import COMPONENTS, ComponentName, TorqueConvention
from service.foundation.errors import invalid_request
from service.foundation.fields import to_array
from service.models.schema import AliasName, VersionNumber

_NUMBERS: dict[str, Any] = {"type": "array", "items": {"type": "number"}}
_ROWS: dict[str, Any] = {"type": "array", "items": _NUMBERS}


def _to_array(value: Any, info: ValidationInfo) -> NDArray[np.float64]:
    """JSON rows as an array; see `to_array`."""
    return to_array(info.field_name or "value", value, _row)


def _row(name: str, row: list[Any]) -> list[float]:
    out = []
    for index, number in enumerate(row):
        try:
            valid = type(number) in (int, float) and isfinite(number)
        except OverflowError:
            valid = False
        if not valid:
            raise invalid_request(f"{name}[{index}]", number, "a finite number")
        out.append(float(number))
    return out


Vectors = Annotated[NDArray[np.float64], PlainValidator(_to_array), WithJsonSchema({"anyOf": [_NUMBERS, _ROWS]})]
"""JSON array of shape (n,) for one query or (N, n) for a batch."""


def _each_once(names: list[ComponentName]) -> list[ComponentName]:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise invalid_request(f"components[{index}]", name, "each component once")
    return names


ComponentNames = Annotated[
    list[ComponentName],
    AfterValidator(_each_once),
    Field(max_length=len(COMPONENTS), json_schema_extra={"uniqueItems": True}),
]
Part = Literal["all", "held_out"]
"""Of a data set that a model is compared with."""
Nested = float | list[float] | list[list[float]] | list[list[list[float]]]


def one_choice(version: int | None, alias: str | None) -> None:
    """Raise InvalidRequestError where a version is named by its number and by an alias."""
    if version is not None and alias is not None:
        raise invalid_request("alias", alias, f"no alias beside the version, {version}: name one of the two")


class VersionChoice(BaseModel):
    """Which version is meant: a number, an alias, or the one that serves."""

    version: VersionNumber | None = Field(None, description="A version of the model; the one that serves by default")
    alias: AliasName | None = Field(None, description="A version by a name that it was given, instead of its number")

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        one_choice(self.version, self.alias)
        return self


MinRevision = Annotated[
    int | None,
    Field(
        ge=0,
        lt=2**31,
        description="Answer with this revision of the version or a later one, as the `revision` of an acknowledgement: "
        "what was taught is in the answer, whichever service took it. Waits up to LIPSERVE_MIN_REVISION_WAIT_S, then "
        "503 `revision_not_reached`. Revisions count for one version: where another may have been promoted since, "
        "name the `version` of the acknowledgement too",
    ),
]


class PredictRequest(VersionChoice):
    """One query, or a batch of them, in SI units."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        arbitrary_types_allowed=True,
        json_schema_extra={
            "examples": [
                {
                    "q": [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7],
                    "dq": [0.1, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0],
                    "ddq": [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0],
                    "components": ["gravity", "kinetic_energy"],
                }
            ]
        },
    )

    q: Vectors = Field(description="Positions, rad (prismatic: m): (n) or (N, n)")
    dq: Vectors = Field(description="Velocities, rad/s (m/s)")
    ddq: Vectors = Field(description="Accelerations, rad/s² (m/s²)")
    covariance: bool = Field(False, description="Also answer the covariance of the function between joints")
    components: ComponentNames = Field(
        default=[],
        description="Also answer these parts of the dynamics. Energy and rigid-body estimators offer all, others "
        "`friction`. They cost several times a torque: the most queries of such a request are fewer",
    )
    tau: Vectors | None = Field(None, description="Torque that `forward_dynamics` is asked for, N·m (prismatic: N)")
    min_revision: MinRevision = None


class ComponentValues(BaseModel):
    """A component at one query or a batch: numbers, vectors (n) or matrices (n, n) a query."""

    mean: Nested
    std: Nested = Field(description="Standard deviation of the function; of forward dynamics to first order")


class PredictResponse(BaseModel):
    """Torques, shaped as the query. An interval that shall hold measurements needs both standard deviations."""

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    joint_names: list[str]
    torque_convention: TorqueConvention
    tau: list[float] | list[list[float]] = Field(description="Mean torque, N·m (prismatic: N)")
    tau_std: list[float] | list[list[float]] = Field(description="Standard deviation of the function")
    noise_std: list[float] = Field(description="Standard deviation of the measurement, per joint")
    covariance: list[list[float]] | list[list[list[float]]] | None = Field(None, description="(N·m)², where asked for")
    components: dict[ComponentName, ComponentValues] | None = Field(
        None,
        description="Where asked for. `inertia_matrix` M(q), kg·m²; torques `inertial` M(q) ddq, `coriolis`, `gravity` "
        "and `friction`, N·m, which sum to `tau`; `kinetic_energy`, J; `potential_energy`, J, relative to the posture "
        "in the middle of each joint's training range; `forward_dynamics`, rad/s²: the acceleration under the torque "
        "asked for. Friction is in `friction` and `forward_dynamics` alone; a model of gravity-compensated torques "
        "knows no gravity",
    )


class EvaluateRequest(VersionChoice):
    """Which data set to compare a model with."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "version": 1}]}
    )

    dataset: str = Field(max_length=40)
    part: Part = Field(
        "all",
        description="`held_out`: only what the training of the version has held out of the data set, see `holdout` of "
        "a job",
    )
    min_revision: MinRevision = None


class Interval(BaseModel):
    """What the central intervals of one probability hold, per joint."""

    level: float = Field(description="Probability that the interval promises")
    coverage: list[float] = Field(description="Share of measurements inside the interval, noise included")
    interval_width: list[float] = Field(description="Mean width of the interval, N·m")


class Reliability(BaseModel):
    """Reliability curve: observed equals nominal where uncertainty is true, and lies below where it is too small."""

    nominal: list[float] = Field(description="Probabilities that intervals promise")
    observed: list[list[float]] = Field(
        description="Share of measurements inside: for each joint one list, like nominal"
    )


class Stretches(BaseModel):
    """How the error is spread over the recording: nMSE stretch by stretch, for a box plot."""

    kind: Literal["episodes", "equal"] = Field(
        description="`episodes` where the samples have 5 to 200 of them, else `equal`: ten stretches of as many samples"
    )
    samples: list[int] = Field(description="Samples compared of each stretch, in order of rows")
    nmse: list[list[float | None]] = Field(
        description="For each joint one list, like samples: mean squared error within the stretch / variance of the "
        "measured torque over *all* samples compared, so that a stretch in which a joint hardly moves does not stand "
        "out; weighted by `samples` they average to the joint's `nmse`. null where the torque does not vary"
    )


class EvaluateResponse(BaseModel):
    """Figures per joint. nmse is null for a joint whose measured torque does not vary."""

    model: str
    version: int
    revision: int
    dataset: str
    part: Part
    joint_names: list[str]
    samples: int = Field(description="Samples of the data set, or of the part")
    samples_used: int = Field(description="Samples compared: evenly thinned where there are more than the limit")
    level: float = Field(description="Probability that the interval promises")
    nmse: list[float | None] = Field(description="Mean squared error / variance of the measured torque")
    rmse: list[float] = Field(description="N·m")
    coverage: list[float] = Field(description="Share of measurements inside the interval, noise included")
    nlpd: list[float] = Field(description="Mean negative log predictive density, nats")
    interval_width: list[float] = Field(description="Mean width of the interval, N·m")
    coverages: list[Interval] = Field(description="Coverage and width of the 50, 80, 95 and 99 % intervals")
    reliability: Reliability
    stretches: Stretches
    in_training: bool = Field(
        description="Whether the model was trained on these samples: then the figures flatter. Not on what it held out"
    )
