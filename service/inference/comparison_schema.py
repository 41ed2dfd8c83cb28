"""Comparisons of two versions as the API shows them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from service.models.schema import AliasName, VersionNumber

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
