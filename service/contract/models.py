"""Models, versions, aliases and the held-out parts of their training."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, StringConstraints, model_validator

from lipcore.data.splits import Kind, Split
from lipcore.model.acceptance import Acceptance
from lipcore.vocabulary import JointType, TorqueConvention
from service.contract.states import PromotionOption

ModelName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")]
"""Lower-case letters, digits, dots, underscores and hyphens: safe in URLs and never a path."""
VersionNumber = Annotated[int, Field(ge=1, lt=2**31)]
ALIAS = r"^[a-z][a-z0-9._-]{0,63}$"
VERSION = r"^[a-z0-9][a-z0-9._-]{0,63}(:[1-9][0-9]{0,8}|@[a-z][a-z0-9._-]{0,63})?$"
"""A version in one text: `model:3`, `model@alias`, or `model` for the serving version."""
AliasName = Annotated[str, StringConstraints(pattern=ALIAS)]
"""A letter, then lower-case letters, digits, dots, underscores and hyphens: never a version number."""


class SelectionCandidate(BaseModel):
    """Quality of an estimator on the part held out for the choice; null if it was not evaluated."""

    estimator: str
    log_density: float | None = Field(description="Log predictive density, summed over the joints, nats a sample")
    difference: float | None = Field(description="Log density less that of the best estimator")
    standard_error: float | None = Field(description="Standard error of the difference")
    nmse: list[float | None] | None = Field(description="nMSE per joint; null if its torque is constant")
    edge_nmse: list[float | None] | None = Field(
        None,
        description="Per joint, mean squared error at the edge of the data / variance of the torque in all held-out "
        "rows; null without rows at the edge, and for versions of earlier releases",
    )
    coverage: list[float | None] | None = Field(description="Coverage of the 95 % interval per joint")
    seconds: float
    error: str | None = Field(description="Why it could not be trained; null if it was")


class SelectionHeldOut(BaseModel):
    """Part that `auto` held out for the choice; the chosen estimator was then trained on it too."""

    rows: int
    blocks: int = Field(description="Number of contiguous ranges of these rows")
    repeats: bool = Field(
        description="Whether all motion of the recording repeats itself, so that figures are too good, except at the "
        "edge"
    )
    edge_rows: int = Field(0, description="Rows at the edge of the data: their states are furthest from all others")
    edge_blocks: int = Field(0, description="Number of contiguous ranges of the rows at the edge")


class Selection(BaseModel):
    """Choice of the estimator by `auto`."""

    asked: str
    chosen: str
    reason: str
    held_out: SelectionHeldOut
    table: list[SelectionCandidate] = Field(description="Trained estimators, simplest first")


class Promotion(BaseModel):
    """Whether a new version became the serving version, and why. The held-out part of its training decides."""

    answers: bool = Field(description="Whether it started to serve after training; else it got the alias `candidate`")
    passed: bool | None = Field(
        description="Whether its error is below that of the mean torque on every joint, coverage is at least 90 %, and "
        "it is not worse than the serving version; null if that cannot be determined"
    )
    serving: int | None = Field(description="Serving version until then; null if there was none")
    reason: str

    @classmethod
    def of(cls, found: Acceptance, serving: int | None, option: PromotionOption = "ask") -> Promotion:
        """Decide whether a version serves: if it has passed the check, or if its owner always promotes."""
        passed, reason = found.passed, found.reason
        if not passed and option == "always":
            reason += "; it serves, because `promotion` is always"
        return cls(answers=passed is True or option == "always", passed=passed, serving=serving, reason=reason)


class HeldOutQuality(BaseModel):
    """Quality of the evaluated fit of a version on the held-out part, per joint; null if torque is constant."""

    samples: int = Field(description="Number of held-out samples")
    nmse: list[float | None] = Field(description="Mean squared error / variance of the measured torque")
    coverage: list[float | None] = Field(description="Share of measurements inside the 95 % interval")
    coverage_low: list[float] = Field(description="Lower end of the confidence interval of the coverage")
    coverage_high: list[float] = Field(description="Upper end of this confidence interval")


class Version(BaseModel):
    """An immutable, trained version."""

    model: str
    version: int
    created_at: str
    job: str | None = Field(description="Job that trained it; null for an imported or shipped version")
    estimator: str
    joint_names: list[str]
    joint_types: list[JointType]
    torque_convention: TorqueConvention
    noise_std: list[float] = Field(description="Standard deviation of the measured torque, N·m")
    training_range: dict[str, dict[str, list[float]]] = Field(
        description="Range of the training samples by quantity and joint"
    )
    options: dict[str, Any]
    fit: dict[str, Any] = Field(description="Report of the fit")
    compact: dict[str, Any] = Field(
        description="Size of the served posterior and its deviation from the exact one at `queries` motions: "
        "`mean_rms`, `mean_max` and `std_max`, in standard deviations of the function"
    )
    calibration: dict[str, Any] = Field(
        description="`function_std_factor`: factor on `tau_std` that calibrates intervals on unseen motion"
    )
    conformal: dict[str, Any] | None = Field(
        None,
        description="Calibration of intervals on `blocks` of the training data, held out in turn: `scale`, the factor "
        "on the half width per joint, and `guaranteed`, the min share of measurements inside; null for the shipped "
        "model",
    )
    hyperparameters: dict[str, Any] = Field(description="Hyperparameters by name, mostly logarithms")
    warnings: list[str] = Field(
        description="Limits of the version, such as unidentifiable parameters of a learnt arm or a fit that did not "
        "converge"
    )
    lineage: dict[str, Any] = Field(
        description="Data sets with their hashes, time and `software` of the training, and `training_metrics`; also "
        "the version it started from (`base`) and the origin of an imported version (`imported`)"
    )
    promotion: Promotion | None = Field(
        None, description="Whether it became the serving version; null for a refreshed or shipped version"
    )
    selection: Selection | None = Field(None, description="Choice of the estimator; null if the request named it")
    robot: dict[str, Any] | None = Field(None, description="URDF and prior of an estimator with rigid bodies")
    parameters: dict[str, Any] = Field(
        description="`friction`; for rigid bodies also `inertia`, `rotor` and `geometry`, with standard deviations and "
        "unidentifiable parameters (`undetermined`). `geometry.joints` run from base to tip, and `geometry.order` has "
        "the model's joint at each place. All else is in the order of the model's joints",
    )


class VersionSummary(BaseModel):
    """A version in the list of its model."""

    version: int
    created_at: str
    estimator: str
    quality: HeldOutQuality | None = Field(
        None, description="Quality on the held-out part of its training; null if nothing was held out"
    )
    promotion: Promotion | None = Field(
        None, description="Whether it became the serving version, and why; null for a refreshed or shipped version"
    )


class Model(BaseModel):
    """A named model. Queries go to its serving version unless they name another one."""

    name: str
    created_at: str
    latest_version: int = Field(description="Newest version")
    serving_version: int | None = Field(
        description="Version that serves queries without a version; null if all versions are candidates"
    )
    aliases: dict[str, int] = Field(description="Versions by alias, without `serving`")
    versions: list[VersionSummary]


class ModelPage(BaseModel):
    """One page of models, newest first."""

    items: list[Model]
    next_cursor: str | None


class AliasRequest(BaseModel):
    """Target of an alias: a version, or the present target of another alias."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"version": 2}, {"alias": "candidate"}]}
    )

    version: VersionNumber | None = Field(None, description="A version of the model")
    alias: AliasName | None = Field(None, description="Another alias of the model, instead of a version")


class AliasMove(BaseModel):
    """One move of an alias."""

    version: int | None = Field(description="New target; null if the alias was removed")
    before: int | None = Field(description="Old target; null if the alias was new")
    at: str
    rollback: bool = Field(description="Whether it undid an earlier move")


class Alias(BaseModel):
    """A movable name of a version."""

    alias: str
    version: int
    changed_at: str
    previous: int | None = Field(description="Version after a rollback; null if no rollback is possible")
    history: list[AliasMove] = Field(description="Latest moves, newest first")


class AliasList(BaseModel):
    """All aliases of a model, `serving` first, on one page."""

    items: list[Alias]
    next_cursor: None = None


_DEFAULTS = Split()


HoldoutKind = Literal["auto", "stretches", Kind]
"""Choice of the held-out part; `auto` depends on the motion, `stretches` are given."""
Row = Annotated[int, Field(ge=0, lt=2**63)]
Stretch = Annotated[list[Row], Field(min_length=2, max_length=2)]
"""Rows of a data set in order of episode and time: first, and last (exclusive)."""


class Holdout(BaseModel):
    """Part of the data that is held out to evaluate a version: contiguous rows, not random ones."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{"share": 0.3}]})

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
