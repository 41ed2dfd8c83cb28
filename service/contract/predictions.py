"""Torque queries, and comparisons of models with data sets."""

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
from service.contract.body import RequestBody
from service.contract.holdout import Evaluation
from service.contract.models import AliasName, VersionNumber
from service.contract.payload import Payload
from service.contract.states import Outcome
from service.contract.verdict import Verdict
from service.foundation.errors import invalid_request
from service.foundation.fields import MAX_NAME_CHARS, check_unique, list_of_numbers, rows_of_numbers

Vectors = Annotated[
    NDArray[np.float64], PlainValidator(rows_of_numbers(), json_schema_input_type=list[float] | list[list[float]])
]
"""JSON array of shape (n,) for one query or (N, n) for a batch."""
Times = Annotated[NDArray[np.float64], PlainValidator(list_of_numbers(), json_schema_input_type=float | list[float])]
"""JSON array of shape (N,), or a number for one query."""


ComponentNames = Annotated[
    list[ComponentName],
    # checked first, so that a long list is not read
    Field(max_length=len(COMPONENTS), json_schema_extra={"uniqueItems": True}),
    AfterValidator(check_unique),
]
Part = Literal["all", "held_out"]
"""Part of the data set with which a model is compared."""
Nested = float | list[float] | list[list[float]] | list[list[list[float]]]


def one_choice(version: int | None, alias: str | None) -> None:
    """Raise InvalidRequestError if a version is given both by number and by alias."""
    if version is not None and alias is not None:
        message = f"Both `version` ({version}) and `alias` ({alias}) are given. Give only one of them."
        raise invalid_request("alias", alias, "no alias beside a version", message)


class VersionChoice(RequestBody):
    """Choice of a version: a number, an alias, or by default the serving version."""

    version: VersionNumber | None = Field(None, description="Version of the model; the serving version by default")
    alias: AliasName | None = Field(None, description="Alias of a version, instead of its number")

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        one_choice(self.version, self.alias)
        return self


MinRevision = Annotated[
    int | None,
    Field(
        ge=0,
        lt=2**31,
        description="Min revision of the version. With the `revision` of an acknowledgement, the response contains "
        "that batch, whichever process received it. Waits up to LIPSERVE_MIN_REVISION_WAIT_S, then fails with 503 "
        "`revision_not_reached`. Revisions belong to one version: if another one may have been promoted since, also "
        "give the `version` of the acknowledgement",
    ),
]


_BEFORE = "history."
_EarlierTimes = Annotated[
    NDArray[np.float64], PlainValidator(list_of_numbers(within=_BEFORE), json_schema_input_type=list[float])
]
_EarlierRows = Annotated[
    NDArray[np.float64], PlainValidator(rows_of_numbers(within=_BEFORE), json_schema_input_type=list[list[float]])
]


class History(RequestBody):
    """Motion before the first row of a query: at most 1000 rows in order of time."""

    t: _EarlierTimes = Field(description="Times, s, by the clock of the request's `t`: (N), rising")
    q: _EarlierRows = Field(description="Positions, rad (prismatic: m): (N, n)")
    dq: _EarlierRows = Field(description="Velocities, rad/s (m/s): (N, n)")


class PredictRequest(VersionChoice):
    """One query or a batch of queries, in SI units."""

    model_config = ConfigDict(
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
    covariance: bool = Field(False, description="Also return the covariance of the function between joints")
    components: ComponentNames = Field(
        default=[],
        description="Also return these parts of the dynamics. Energy and rigid-body estimators offer all of them, "
        "others `friction`. They cost several times as much as a torque, so the max batch size is smaller",
    )
    tau: Vectors | None = Field(None, description="Torque for `forward_dynamics`, N·m (prismatic: N)")
    t: Times | None = Field(
        None, description="Times, s: (N), rising; a number for one query. For `trajectory` and `history` only"
    )
    trajectory: bool = Field(
        False,
        description="The rows of the batch are one motion in order of time. Friction that remembers the motion before "
        "a state then follows the rows. By default each row is a query alone: the motion before it is unknown, and "
        "`tau_std` is larger at low speed. Models without such friction ignore this",
    )
    history: History | None = Field(
        None,
        description="Motion before the query, or before the first row of a trajectory. It counts as unknown if it ends "
        "more than 0.25 s earlier",
    )
    min_revision: MinRevision = None
    payload: Payload | None = Field(
        None,
        description="Predict for the arm with this payload on its last link, and no other. For models with rigid "
        "bodies, such as `rigid-body`. The payload counts as exact: `tau_std` is the uncertainty of the arm with it. A "
        "model of gravity-compensated torques leaves out its weight as well",
    )


class ComponentValues(BaseModel):
    """A component for one query or a batch: a number, a vector (n) or a matrix (n, n) per query."""

    mean: Nested
    std: Nested = Field(description="Standard deviation of the function; for forward dynamics to first order")


class PredictResponse(BaseModel):
    """Torques in the shape of the query.

    The 95 % interval of a measurement is tau ± 1.96 · scale · sqrt(tau_std² + noise_std²).
    """

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    joint_names: list[str]
    torque_convention: TorqueConvention
    tau: list[float] | list[list[float]] = Field(description="Mean torque, N·m (prismatic: N)")
    tau_std: list[float] | list[list[float]] = Field(description="Standard deviation of the function")
    noise_std: list[float] = Field(description="Standard deviation of the measurement, per joint")
    scale: list[float] = Field(
        description="Factor on the half width of intervals, per joint. It is the largest factor that recent streams "
        "need for the nominal coverage, and at least 1 and the factor that held-out blocks of the training need"
    )
    guaranteed: list[float] | None = Field(
        None,
        description="Min coverage of the 95 % interval, per joint, that held-out blocks of the training guarantee for "
        "similar motion; below 95 % with fewer than 19 blocks. Null for the shipped model",
    )
    covariance: list[list[float]] | list[list[list[float]]] | None = Field(
        None, description="Covariance of the function between joints, (N·m)²; null unless requested"
    )
    components: dict[ComponentName, ComponentValues] | None = Field(
        None,
        description="Requested components. `inertia_matrix` M(q), kg·m²; torques `inertial` M(q) ddq, `coriolis`, "
        "`gravity` and `friction`, N·m, which sum to `tau` without fallback; `without_gravity`, N·m, `tau` minus "
        "gravity, for robots that add it; its `std` is that of the difference; `kinetic_energy`, J; "
        "`potential_energy`, "
        "J, relative to the middle of each joint's training range; `forward_dynamics`, rad/s²: the acceleration under "
        "the given torque. Friction is only in `friction` and `forward_dynamics`. A model of gravity-compensated "
        "torques has no gravity",
    )
    fallback: list[float] | list[list[float]] | None = Field(
        None,
        description="Share of the fallback in each torque, 0 to 1, in the shape of `tau`; absent if all are zero. At "
        "1, training does not determine the torque of this motion: `tau` is only gravity, offset and friction, or the "
        "mean training torque if these are not determined either. `tau_std` is that of the full model",
        examples=[[0.0, 0.0, 0.0, 0.0, 0.35, 1.0, 0.0]],
    )


class EvaluateRequest(VersionChoice):
    """Data set with which a model is compared."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "version": 1}]})

    dataset: str = Field(max_length=MAX_NAME_CHARS, description="Id or name of a data set")
    part: Part = Field(
        "all",
        description="`held_out`: only the held-out part of the version's training, see `holdout` of a job. If the "
        "version was trained on this part afterwards, `evaluate` returns the figures of the evaluated fit",
    )
    min_revision: MinRevision = None


class EvaluateResponse(Evaluation):
    """Figures per joint. `nmse` is null for a joint with constant measured torque."""

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version; 0 for figures of the evaluated fit")
    dataset: str
    part: Part
    joint_names: list[str]
    in_training: bool = Field(
        description="Whether the version was trained on these samples, so that the figures are too good"
    )
    judged: bool = Field(
        description="Whether the figures are of the evaluated fit, which was trained without these samples before the "
        "version was trained on all"
    )
    verdict: Verdict = Field(description="Verdict on the version by these figures")


TraceComponent = Literal["inertial", "coriolis", "gravity", "friction"]
"""Parts of the torque, which sum to its mean."""
Row = Annotated[int, Field(ge=0, lt=2**53)]


class TraceRequest(EvaluateRequest):
    """Rows of a data set along which a model is traced."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "points": 500, "components": ["gravity"]}]},
    )

    start: Row = Field(0, description="First row of the data set, counted from 0")
    stop: Row | None = Field(None, description="Row after the last one; by default and at most the end of the data set")
    points: int = Field(
        1000, ge=1, lt=2**31, description="Max rows to show, evenly chosen. The limit is 2000 by default"
    )
    components: Annotated[
        list[TraceComponent], Field(max_length=4, json_schema_extra={"uniqueItems": True}), AfterValidator(check_unique)
    ] = Field([], description="Also return these parts of the torque if the estimator offers them, as in `predict`")


class TraceComponentValues(BaseModel):
    """A part of the torque at the rows shown, N·m, one list of joints per row."""

    mean: list[list[float]]
    std: list[list[float]] = Field(description="Standard deviation of the function")


class TraceResponse(BaseModel):
    """Measured and predicted torque at rows of a data set, N·m (prismatic: N), one list of joints per row.

    The 95 % interval of a measurement is mean ± 1.96 · scale · sqrt(std² + noise_std²).
    """

    model: str
    version: int
    revision: int = Field(description="Online updates applied to the version")
    dataset: str
    part: Part
    joint_names: list[str]
    torque_convention: TorqueConvention
    samples: int = Field(description="Samples of the data set, or of the part")
    in_range: int = Field(description="Number of these samples from `start` to `stop`")
    shown: int = Field(
        description="Number of samples shown. If fewer than `in_range`, they are evenly chosen and peaks may be missing"
    )
    rows: list[int] = Field(description="Rows of these samples in the data set, counted from 0")
    t: list[float] = Field(description="Times of these samples, s")
    breaks: list[int] = Field(
        description="Indices in `rows` at which another episode or another piece of the held-out part begins. Plots "
        "should break lines there"
    )
    tau: list[list[float]] = Field(description="Measured torque")
    mean: list[list[float]] = Field(description="Predicted torque")
    std: list[list[float]] = Field(description="Standard deviation of the function")
    noise_std: list[float] = Field(description="Standard deviation of the measurement, per joint")
    scale: list[float] = Field(description="The version's own factor on the half width of intervals, per joint")
    offered: list[TraceComponent] = Field(description="Components that can be requested")
    components: dict[TraceComponent, TraceComponentValues]
    in_training: bool = Field(
        description="Whether the version was trained on these samples, even if they were held out at first, so that it "
        "looks better than it is"
    )


class CompareRequest(RequestBody):
    """Two versions to compare on a data set."""

    model_config = ConfigDict(
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
    in_training: bool = Field(
        description="Whether the version was trained on this data set, so that its figures are too good"
    )
    verdict: Verdict = Field(description="Verdict on the version by these figures")


class Differences(BaseModel):
    """The second version's figure less the first's, per joint.

    Errors are null if the samples form a single block. For nMSE, all is null for a joint with constant measured torque.
    """

    difference: list[float | None]
    standard_error: list[float | None] = Field(
        description="Standard error of the paired difference, with correlation in time"
    )
    half_width: list[float | None] = Field(description="Half the width of the 95 % interval of the difference")


class JointDifferences(BaseModel):
    """Differences per joint, by figure."""

    nmse: Differences
    rmse: Differences
    coverage: Differences
    nlpd: Differences


class TotalDifference(BaseModel):
    """The second version's figure less the first's, all joints combined; null if it cannot be determined."""

    difference: float | None
    standard_error: float | None
    half_width: float | None


class CompareResponse(BaseModel):
    """Two versions compared on one data set."""

    model: str
    dataset: str
    joint_names: list[str]
    samples: int = Field(description="Samples of the data set")
    samples_used: int = Field(description="Compared samples, evenly thinned above the limit")
    blocks: int = Field(
        description="Blocks for standard errors: segments of one second, or episodes if there are enough"
    )
    versions: list[VersionFigures] = Field(description="The two versions in the order of the request")
    differences: JointDifferences
    nlpd: TotalDifference = Field(
        description="Negative log predictive density, nats per sample, summed over the joints"
    )
    nmse: TotalDifference = Field(description="nMSE, averaged over the joints with varying torque")
    outcome: Outcome = Field(
        description="Outcome by the negative log predictive density, which rewards small errors and right uncertainty. "
        "`cannot_tell`: too few blocks"
    )
    better: int | None = Field(description="The better version by this outcome; null if there is none")
    verdict: str = Field(description="Outcome in words")
    warnings: list[str] = Field(description="Reasons why the comparison is unfair")
