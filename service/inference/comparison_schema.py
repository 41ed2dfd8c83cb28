"""What compares models with data sets, as the API takes and shows it: traces, and two versions."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lipcore.vocabulary import TorqueConvention
from service.foundation.errors import invalid_request
from service.inference.schema import EvaluateRequest, Part
from service.models.schema import AliasName, VersionNumber

TraceComponent = Literal["inertial", "coriolis", "gravity", "friction"]
"""Parts of the torque, which sum to its mean."""
Row = Annotated[int, Field(ge=0, lt=2**53)]


def _each_once(names: list[TraceComponent]) -> list[TraceComponent]:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise invalid_request(f"components[{index}]", name, "each component once")
    return names


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
        list[TraceComponent], AfterValidator(_each_once), Field(max_length=4, json_schema_extra={"uniqueItems": True})
    ] = Field([], description="Also answer these parts of the torque, where the estimator offers them, as in `predict`")


class TraceComponentValues(BaseModel):
    """A part of the torque at the rows shown, N·m, one list of joints a row."""

    mean: list[list[float]]
    std: list[list[float]] = Field(description="Standard deviation of the function")


class TraceResponse(BaseModel):
    """Measured and predicted torque at rows of a data set, N·m (prismatic: N), one list of joints a row.

    An interval that shall hold the measurements needs both standard deviations: mean ± 1.96 · sqrt(std² + noise_std²)
    for 95 % of them.
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
    offered: list[TraceComponent] = Field(description="Components that may be asked for")
    components: dict[TraceComponent, TraceComponentValues]
    in_training: bool = Field(
        description="Whether the model was trained on these samples: then it looks better than it is. Not on what it "
        "held out"
    )


Outcome = Literal["first_better", "second_better", "no_difference", "cannot_tell"]


class CompareRequest(BaseModel):
    """Which two versions to compare, and on which data set."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={"examples": [{"dataset": "ds_0123456789abcdef", "versions": ["production", 2]}]},
    )

    dataset: str = Field(max_length=40)
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
