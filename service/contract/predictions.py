"""Torque queries, and comparisons of models with data sets, as the API takes and answers them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    model_validator,
)

from lipcore.vocabulary import COMPONENTS, ComponentName, TorqueConvention
from service.contract.models import AliasName, Evaluation, VersionNumber
from service.contract.payload import Payload
from service.contract.states import Outcome
from service.foundation.errors import invalid_request
from service.foundation.fields import MAX_NAME_CHARS, check_unique, rows_of_numbers

Vectors = Annotated[
    NDArray[np.float64], PlainValidator(rows_of_numbers(), json_schema_input_type=list[float] | list[list[float]])
]
"""JSON array of shape (n,) for one query or (N, n) for a batch."""


ComponentNames = Annotated[
    list[ComponentName],
    Field(max_length=len(COMPONENTS), json_schema_extra={"uniqueItems": True}),  # first: a long list is not looked at
    AfterValidator(check_unique),
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
    payload: Payload | None = Field(
        None,
        description="Answer for the arm with this on its last link, and nothing else that it did not have in training. "
        "For models with rigid bodies, as of `rigid-body`. It is taken as exact: `tau_std` is what the model does not "
        "know of the arm with it. A model of gravity-compensated torques leaves out its weight, too",
    )


class ComponentValues(BaseModel):
    """A component at one query or a batch: numbers, vectors (n) or matrices (n, n) a query."""

    mean: Nested
    std: Nested = Field(description="Standard deviation of the function; of forward dynamics to first order")


class PredictResponse(BaseModel):
    """Torques, shaped as the query. An interval that shall hold measurements needs both standard deviations and the
    scale: tau ± 1.96 · scale · sqrt(tau_std² + noise_std²) for 95 % of them."""

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    joint_names: list[str]
    torque_convention: TorqueConvention
    tau: list[float] | list[list[float]] = Field(description="Mean torque, N·m (prismatic: N)")
    tau_std: list[float] | list[list[float]] = Field(description="Standard deviation of the function")
    noise_std: list[float] = Field(description="Standard deviation of the measurement, per joint")
    scale: list[float] = Field(
        description="Factor on the half width, per joint: what the streams that teach the model need now for intervals "
        "that hold what they promise, the largest of the recent ones; at least what left-out blocks of the training "
        "have proved, and 1"
    )
    guaranteed: list[float] | None = Field(
        None,
        description="Share of measurements that left-out blocks of the training guarantee for the 95 % interval, per "
        "joint, for motion of that kind: less where there are fewer than 19; null for the shipped model",
    )
    covariance: list[list[float]] | list[list[list[float]]] | None = Field(None, description="(N·m)², where asked for")
    components: dict[ComponentName, ComponentValues] | None = Field(
        None,
        description="Where asked for. `inertia_matrix` M(q), kg·m²; torques `inertial` M(q) ddq, `coriolis`, `gravity` "
        "and `friction`, N·m, which sum to `tau` unless it falls back; `kinetic_energy`, J; `potential_energy`, J, "
        "relative to the posture in the middle of each joint's training range; `forward_dynamics`, rad/s²: the "
        "acceleration under the torque "
        "asked for. Friction is in `friction` and `forward_dynamics` alone; a model of gravity-compensated torques "
        "knows no gravity",
    )
    fallback: list[float] | list[list[float]] | None = Field(
        None,
        description="Share of the fallback in each torque, 0 to 1, shaped as `tau`; absent if all are zero. At 1 the "
        "training does not determine the torque of this motion: `tau` is gravity, offset and friction only, or the "
        "mean torque of the training if these are not determined either. `tau_std` is that of the full model",
        examples=[[0.0, 0.0, 0.0, 0.0, 0.35, 1.0, 0.0]],
    )


class EvaluateRequest(VersionChoice):
    """Which data set to compare a model with."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "version": 1}]}
    )

    dataset: str = Field(max_length=MAX_NAME_CHARS, description="Id or name of a data set")
    part: Part = Field(
        "all",
        description="`held_out`: only what the training of the version has held out of the data set, see `holdout` of "
        "a job. If the version has learnt that since, `evaluate` returns the figures of the judged fit",
    )
    min_revision: MinRevision = None


class EvaluateResponse(Evaluation):
    """Figures per joint. nmse is null for a joint whose measured torque does not vary."""

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version; 0 for figures of a judged fit")
    dataset: str
    part: Part
    joint_names: list[str]
    in_training: bool = Field(description="Whether the version has learnt these samples: then the figures flatter")
    judged: bool = Field(
        description="Whether the figures are of the judged fit, which was trained without these samples; the version "
        "was then trained on all"
    )


TraceComponent = Literal["inertial", "coriolis", "gravity", "friction"]
"""Parts of the torque, which sum to its mean."""
Row = Annotated[int, Field(ge=0, lt=2**53)]


class TraceRequest(EvaluateRequest):
    """Which rows of which data set to follow a model along."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "points": 500, "components": ["gravity"]}]},
    )

    start: Row = Field(0, description="First row of the data set, counted from 0")
    stop: Row | None = Field(None, description="Row to end before; the end of the data set by default and at most")
    points: int = Field(
        1000, ge=1, lt=2**31, description="Rows to show; evenly chosen where there are more. At most 2000 by default"
    )
    components: Annotated[
        list[TraceComponent], Field(max_length=4, json_schema_extra={"uniqueItems": True}), AfterValidator(check_unique)
    ] = Field([], description="Also answer these parts of the torque, where the estimator offers them, as in `predict`")


class TraceComponentValues(BaseModel):
    """A part of the torque at the rows shown, N·m, one list of joints a row."""

    mean: list[list[float]]
    std: list[list[float]] = Field(description="Standard deviation of the function")


class TraceResponse(BaseModel):
    """Measured and predicted torque at rows of a data set, N·m (prismatic: N), one list of joints a row.

    An interval that shall hold the measurements needs both standard deviations and the scale:
    mean ± 1.96 · scale · sqrt(std² + noise_std²) for 95 % of them.
    """

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    dataset: str
    part: Part
    joint_names: list[str]
    torque_convention: TorqueConvention
    samples: int = Field(description="Samples of the data set, or of the part")
    in_range: int = Field(description="Samples of these from `start` to `stop`")
    shown: int = Field(description="Samples shown: evenly chosen where fewer than `in_range`, and peaks may be missing")
    rows: list[int] = Field(description="Their rows in the data set, counted from 0")
    t: list[float] = Field(description="Their times, s")
    breaks: list[int] = Field(
        description="Places in `rows` at which another episode begins, or another piece of the part held out: lines "
        "are not to be drawn across"
    )
    tau: list[list[float]] = Field(description="Measured torque")
    mean: list[list[float]] = Field(description="Predicted torque")
    std: list[list[float]] = Field(description="Standard deviation of the function")
    noise_std: list[float] = Field(description="Standard deviation of the measurement, per joint")
    scale: list[float] = Field(description="The version's own factor on the half width of its intervals, per joint")
    offered: list[TraceComponent] = Field(description="Components that may be asked for")
    components: dict[TraceComponent, TraceComponentValues]
    in_training: bool = Field(
        description="Whether the version has learnt these samples, even if they were held out: then it looks better "
        "than it is"
    )


class CompareRequest(BaseModel):
    """Which two versions to compare, and on which data set."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "versions": ["production", 2]}]},
    )

    dataset: str = Field(max_length=MAX_NAME_CHARS, description="Id or name of a data set")
    versions: Annotated[list[VersionNumber | AliasName], Field(min_length=2, max_length=2)] = Field(
        description="Two versions of the model, by number or alias"
    )


class VersionFigures(BaseModel):
    """Figures of one version on the data set, per joint; see `evaluate`."""

    version: int
    revision: int = Field(description="Online updates applied to the version")
    nmse: list[float | None]
    rmse: list[float]
    coverage: list[float]
    nlpd: list[float]
    interval_width: list[float]
    in_training: bool = Field(description="Whether the version was trained on this data set: then its figures flatter")


class Differences(BaseModel):
    """The second version's figure less the first's, per joint. Errors are null where the samples make a single block,
    all is null for a joint whose measured torque does not vary, where it is nMSE."""

    difference: list[float | None]
    standard_error: list[float | None] = Field(description="Of the paired difference; it respects correlation in time")
    half_width: list[float | None] = Field(description="Half the width of its 95 % interval")


class JointDifferences(BaseModel):
    """Differences per joint, one of each figure."""

    nmse: Differences
    rmse: Differences
    coverage: Differences
    nlpd: Differences


class TotalDifference(BaseModel):
    """The second version's figure less the first's, all joints together; null where it cannot be told."""

    difference: float | None
    standard_error: float | None
    half_width: float | None


class CompareResponse(BaseModel):
    """Two versions on one data set, and what the difference between them says."""

    model: str
    dataset: str
    joint_names: list[str]
    samples: int = Field(description="Samples of the data set")
    samples_used: int = Field(description="Samples compared: evenly thinned where there are more than the limit")
    blocks: int = Field(
        description="Stretches of a second, or episodes where there are enough, that standard errors stand on"
    )
    versions: list[VersionFigures] = Field(description="The two versions in the order of the request")
    differences: JointDifferences
    nlpd: TotalDifference = Field(description="Negative log predictive density, nats a sample, summed over the joints")
    nmse: TotalDifference = Field(description="nMSE, averaged over the joints whose torque varies")
    outcome: Outcome = Field(
        description="By the negative log predictive density, which rewards small errors and true uncertainty alike; "
        "`cannot_tell` where the samples make too few blocks"
    )
    better: int | None = Field(description="The version that is better by that; null where none is")
    verdict: str = Field(description="The same in words")
    warnings: list[str] = Field(description="What makes the comparison unfair")
