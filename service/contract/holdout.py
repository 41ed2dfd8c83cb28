"""Held-out parts of trainings, and evaluations on them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from lipcore.data.splits import Kind, Split
from service.contract.body import RequestBody

_DEFAULTS = Split()
HoldoutKind = Literal["auto", "stretches", Kind]
"""Choice of the held-out part; `auto` depends on the motion, `stretches` are given."""
Row = Annotated[int, Field(ge=0, lt=2**63)]
Stretch = Annotated[list[Row], Field(min_length=2, max_length=2)]
"""Rows of a data set in order of episode and time: first, and last (exclusive)."""


class Holdout(RequestBody):
    """Part of the data that is held out to evaluate a version: contiguous rows, not random ones."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"share": 0.3}]})

    kind: HoldoutKind = Field(
        "auto",
        description="Held-out part of each data set. `last`: its last part. `episodes`: whole episodes, chosen by the "
        "seed; of several data sets with one episode each, whole data sets. `blocks`: some of many equal blocks, "
        "chosen by the seed. `auto`: the last part, unless that repeats motion of the training part and other periods, "
        "episodes or stretches do not; then some of these, chosen by the seed. `stretches`: the given rows",
    )
    share: float = Field(
        _DEFAULTS.share, gt=0, lt=1, description="Share of the samples, as closely as whole episodes or blocks allow"
    )
    blocks: int = Field(
        _DEFAULTS.blocks, ge=2, le=1000, description="Number of equal blocks from which `blocks` chooses"
    )
    guard_s: float | None = Field(
        None,
        ge=0,
        le=3600,
        description="Samples closer than this to the other part are in neither part, s; by default one period of the "
        "data set's low-pass. In a data set without times, 25 samples",
    )
    seed: int = Field(_DEFAULTS.seed, ge=0, lt=2**31, description="Seed of the random choice")
    stretches: dict[str, Annotated[list[Stretch], Field(min_length=1, max_length=1000)]] | None = Field(
        None,
        max_length=10_000,
        description="For `kind` `stretches`: rows to hold out by data set id, first and last (exclusive), in order of "
        "episode and time. Other data sets are used for training only",
        exclude_if=lambda value: value is None,  # so that lineages of earlier releases compare as equal
    )
    only: bool = Field(
        False,
        description="Whether the version is never trained on these samples. By default it is evaluated without them "
        "and then trained on all samples",
        exclude_if=lambda value: not value,  # as above
    )


class HeldOutSet(BaseModel):
    """Held-out part of one data set, with all that is needed to select the same samples again."""

    model_config = ConfigDict(strict=True)

    id: str = Field(max_length=40)
    sha256: str = Field(max_length=64)
    whole: bool = Field(description="Whether the whole data set was held out")
    guard: float = Field(ge=0, description="Distance between the parts, in `guard_unit`")
    guard_unit: Literal["s", "rows"]
    rows: int = Field(ge=1, lt=2**63, description="Held-out samples")
    guarded: int = Field(ge=0, lt=2**63, description="Samples in neither part")
    stretches: list[Stretch] | None = Field(
        None,
        max_length=1000,
        description="Held-out rows before the guard was removed, first and last (exclusive), in order of episode and "
        "time; null if the split alone determines them",
    )


class Interval(BaseModel):
    """Coverage and width of central intervals of one probability, per joint."""

    level: float = Field(description="Nominal probability of the interval")
    coverage: list[float] = Field(description="Share of measurements inside the interval, noise included")
    interval_width: list[float] = Field(description="Mean width of the interval, N·m")


class Reliability(BaseModel):
    """Reliability curve: `observed` is below `nominal` if the stated uncertainty is too small, else equal or above."""

    nominal: list[float] = Field(description="Nominal probabilities of the intervals")
    observed: list[list[float]] = Field(
        description="Share of measurements inside: one list per joint, as long as `nominal`"
    )


class Stretches(BaseModel):
    """Distribution of the error over the recording: nMSE by stretch, for a box plot."""

    kind: Literal["episodes", "equal"] = Field(
        description="`episodes` if there are 5 to 200, else `equal`: ten segments of equal length"
    )
    samples: list[int] = Field(description="Compared samples of each stretch, in row order")
    nmse: list[list[float | None]] = Field(
        description="One list per joint, as long as `samples`: mean squared error within the stretch / variance of the "
        "measured torque over *all* compared samples, so that a stretch with little motion does not stand out. The "
        "mean weighted by `samples` is the joint's `nmse`. Null if the torque is constant"
    )


class OutsideRange(BaseModel):
    """Quality on the samples outside the training range, per joint; null without such samples."""

    share: float = Field(ge=0, le=1, description="Share of the samples")
    squared: list[float | None] = Field(description="Mean squared error, (N·m)²")
    coverage: list[float | None] = Field(description="Share of measurements inside the 95 % interval")


class Evaluation(BaseModel):
    """Prediction quality on a data set, or on part of it, per joint."""

    samples: int = Field(description="Samples of the data set, or of the part")
    samples_used: int = Field(description="Compared samples, evenly thinned above the limit")
    level: float = Field(description="Nominal probability of the interval")
    nmse: list[float | None] = Field(description="Mean squared error / variance of the measured torque")
    rmse: list[float] = Field(description="Root mean squared error, N·m")
    coverage: list[float] = Field(description="Share of measurements inside the interval, noise included")
    nlpd: list[float] = Field(description="Mean negative log predictive density, nats")
    interval_width: list[float] = Field(description="Mean width of the interval, N·m")
    coverages: list[Interval] = Field(description="Coverage and width of the 50, 80, 95 and 99 % intervals")
    reliability: Reliability
    stretches: Stretches
    independent: list[float] = Field(
        description="Effective samples of the coverage; fewer than `samples_used`, as neighbouring errors are "
        "correlated"
    )
    coverage_low: list[float] = Field(description="Lower end of the 95 % confidence interval of the coverage")
    coverage_high: list[float] = Field(
        description="Upper end of this confidence interval. If it is below 0.9, intervals are too narrow"
    )
    seconds: float | None = Field(None, description="Duration of the samples, s; null for versions of earlier releases")
    moving: float | None = Field(
        None, description="Share of samples in which a joint moves; null for versions of earlier releases"
    )
    torque_range: list[float] | None = Field(
        None, description="Max less min of the measured torque, N·m; null for versions of earlier releases"
    )
    outside: OutsideRange | None = Field(
        None, description="Quality outside the training range; null for versions of earlier releases"
    )
    repeats_training: float | None = Field(
        description="Share of samples with motion (position, velocity and acceleration) that repeats training motion, "
        "so that figures are too good; null if the version was trained on these samples, or if its data sets were "
        "deleted"
    )
    period_s: float | None = Field(description="Period of this motion, s; null if it is not periodic")
    warnings: list[str] = Field(description="Other reasons why the figures may be too good")


class HeldOutBlocks(BaseModel):
    """Scores of the evaluated fit in blocks of held-out samples, with which a later version is compared.

    See `lipcore.data.metrics.BlockScores`.
    """

    model_config = ConfigDict(strict=True)

    rows: list[Annotated[int, Field(ge=1, lt=2**63)]] = Field(min_length=1, description="Rows of each block")
    nlpd: list[FiniteFloat] = Field(description="Sum over these rows of the negative log density of all joints, nats")
    nmse: list[FiniteFloat | None] = Field(description="Sum over these rows of squared error / variance of the torque")

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if not len(self.rows) == len(self.nlpd) == len(self.nmse):
            raise ValueError("rows, nlpd and nmse differ in length")
        return self


class CurvePoint(BaseModel):
    """Error of a fit on held-out samples after training on some samples."""

    model_config = ConfigDict(strict=True)

    rows: int = Field(ge=0, lt=2**63, description="Training samples")
    spread: bool = Field(description="Whether they are spread over the recordings; else they are the first ones")
    nmse: float = Field(ge=0, allow_inf_nan=False, description="Squared error / variance of the torque, mean of joints")


class LearningCurve(BaseModel):
    """Error of the evaluated fit against the number of its training samples."""

    model_config = ConfigDict(strict=True)

    points: list[CurvePoint] = Field(
        max_length=100, description="By number of samples, the last of all; empty if it failed"
    )
    more_helps: bool = Field(description="Whether more samples of the same motion reduce the error beyond chance")
    variety_helps: bool = Field(description="Whether other motion reduces the error beyond chance")
    text: str = Field(max_length=300, description="The conclusion, in a sentence or two")


class HoldoutLineage(BaseModel):
    """Held-out part of a training, in the lineage of its version.

    Figures are those of the evaluated fit, which was trained without the held-out samples.
    """

    model_config = ConfigDict(strict=True)

    split: Holdout
    datasets: list[HeldOutSet] = Field(min_length=1, max_length=10_000)
    rows: int = Field(ge=1, lt=2**63)
    guarded: int = Field(ge=0, lt=2**63)
    learnt: bool = Field(False, description="Whether the version was trained on these samples after the evaluation")
    judged_rows: int | None = Field(None, ge=0, lt=2**63, description="Training samples of the evaluated fit")
    evaluations: dict[str, Evaluation] = Field(
        {}, max_length=10_000, description="If `learnt`: quality of the evaluated fit on the held-out part, by data set"
    )
    blocks: HeldOutBlocks | None = Field(None, description="If `learnt`: scores with which a later version is compared")
    learning_curve: LearningCurve | None = Field(
        None, description="Learning curve; null for a refresh, or if the training has too few effective samples"
    )
