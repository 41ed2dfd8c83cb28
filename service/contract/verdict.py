"""The verdict on a model: one level, why, and what to do. `lipcore.model.judging` decides it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from lipcore.model.verdict import OPTIONS, JudgedOn, Level
from service.contract.body import RequestBody

LABELS: dict[Level, str] = {
    "wrong": "wrong",
    "too_uncertain": "too uncertain to help",
    "not_judged": "not judged",
    "usable_in_range": "usable inside the recorded range",
    "usable": "usable",
}
"""Words for each level."""


class Thresholds(RequestBody):
    """Thresholds of the verdicts on the versions of a model."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"max_error": 0.25}]})

    max_error: float = Field(
        OPTIONS.max_error,
        gt=0,
        le=1,
        description="Max mean squared error of a joint / variance of its torque. Above, the version is `wrong`",
    )
    min_coverage: float = Field(
        OPTIONS.min_coverage,
        ge=0.5,
        le=0.95,
        description="Min coverage of the 95 % intervals, within sampling error. If it is below, the version is `wrong`",
    )
    max_width: float = Field(
        OPTIONS.max_width,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Max width of the 95 % intervals / that of the mean torque. If it is above, the version is "
        "`too_uncertain`",
    )


class JointVerdict(BaseModel):
    """Verdict on one joint. Null stands for an unknown value."""

    model_config = ConfigDict(from_attributes=True)

    joint: str
    level: Level
    unit: str = Field(description="Unit of the torques: N·m, or N for a prismatic joint")
    rmse: float = Field(description="Root mean squared error")
    range_share: float | None = Field(description="`rmse` divided by the range of the measured torque")
    limit_share: float | None = Field(description="`rmse` divided by the rated torque of the robot's actuator")
    mean_rmse: float | None = Field(description="Root mean squared error of the mean torque")
    serving_rmse: float | None = Field(description="That of the serving version on the same samples")
    coverage: float = Field(description="Share of measurements inside the 95 % interval")
    coverage_low: float | None = Field(description="Lower end of the 95 % confidence interval of the coverage")
    coverage_high: float | None = Field(description="Upper end of this confidence interval")
    effective_samples: float | None = Field(description="Effective samples; neighbouring errors are correlated")
    interval_width: float | None = Field(description="Mean width of the 95 % interval")
    width_over_need: float | None = Field(description="This width, relative to that of errors as large as `rmse`")


class Verdict(BaseModel):
    """Verdict on the torque of a version."""

    model_config = ConfigDict(from_attributes=True)

    level: Level = Field(
        description="`usable`; `usable_in_range`: unknown or wrong outside the recorded range; `not_judged`: too few "
        "samples that it has not learnt; `too_uncertain`: intervals no narrower than without a model; `wrong`: errors "
        "no smaller than without a model, intervals that are too narrow, or faulty training data"
    )
    serves: bool = Field(description="Whether a version serves without approval: if it is usable, or usable in range")
    label: str = Field(description="The level in words")
    reason: str = Field(description="Why, in one sentence")
    action: str = Field(description="What to do")
    judged_on: JudgedOn = Field(
        description="`held_out`: the held-out part of its training; `recording`: another data set; `stream`: rows of "
        "streams before they were learnt; `training`: samples that it has learnt; `nothing`"
    )
    outside: float | None = Field(description="Share of the samples outside the training range; null if unknown")
    repeats: float | None = Field(description="Share of the samples that repeat the training motion; null if unknown")
    joints: list[JointVerdict]
