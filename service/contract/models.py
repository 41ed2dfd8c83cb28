"""Models, versions, aliases and what was held out of their training, as the API shows them."""

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
"""A version as one text: `model:3`, `model@alias`, or `model` for the one that serves."""
AliasName = Annotated[str, StringConstraints(pattern=ALIAS)]
"""Lower-case letters, digits, dots, underscores and hyphens after a letter: never taken for a version's number."""


class SelectionCandidate(BaseModel):
    """How an estimator did on what was held out to choose by; null where it was not judged."""

    estimator: str
    log_density: float | None = Field(description="Log predictive density, summed over the joints, nats a sample")
    difference: float | None = Field(description="Of the log density from that of the best")
    standard_error: float | None = Field(description="Of that difference")
    nmse: list[float | None] | None = Field(description="Of each joint; null where its torque does not vary")
    edge_nmse: list[float | None] | None = Field(
        None,
        description="Of each joint, squared error at the edge of the data over the torque's variance in all rows that "
        "were held out; null if none of them are at the edge, and for versions of earlier releases",
    )
    coverage: list[float | None] | None = Field(description="Share within the 95 % interval, of each joint")
    seconds: float
    error: str | None = Field(description="Why it could not be trained")


class SelectionHeldOut(BaseModel):
    """What `auto` held out to choose by; the chosen estimator has learnt it afterwards."""

    rows: int
    blocks: int = Field(description="Contiguous stretches that these rows are")
    repeats: bool = Field(
        description="All motion of the recording repeats other motion of it: figures flatter, except at the edge"
    )
    edge_rows: int = Field(0, description="Rows at the edge of the data: their states are the furthest from all others")
    edge_blocks: int = Field(0, description="Contiguous stretches that the rows at the edge are")


class Selection(BaseModel):
    """How `auto` has chosen the estimator."""

    asked: str
    chosen: str
    reason: str
    held_out: SelectionHeldOut
    table: list[SelectionCandidate] = Field(description="The estimators that were trained, the simplest first")


class Promotion(BaseModel):
    """Whether a version that was trained answers by itself, and why: judged by what its training held out."""

    answers: bool = Field(description="Whether it answered once it was trained; else it waits under alias `candidate`")
    passed: bool | None = Field(
        description="Whether its error is below that of the mean torque on every joint, its intervals hold 90 %, and "
        "it is not worse than the version that serves; null where that cannot be told"
    )
    serving: int | None = Field(description="The version that answered until then; null where none did")
    reason: str

    @classmethod
    def of(cls, found: Acceptance, serving: int | None, option: PromotionOption = "ask") -> Promotion:
        """What becomes of a version: it answers if it has passed, or if its owner wants that in any case."""
        passed, reason = found.passed, found.reason
        if not passed and option == "always":
            reason += "; it answers as was asked for"
        return cls(answers=passed is True or option == "always", passed=passed, serving=serving, reason=reason)


class HeldOutQuality(BaseModel):
    """How well the judged fit of a version predicts what was held out, per joint; null where torque does not vary."""

    samples: int = Field(description="Samples that the figures are of")
    nmse: list[float | None] = Field(description="Mean squared error / variance of the measured torque")
    coverage: list[float | None] = Field(description="Share of measurements inside the 95 % interval")
    coverage_low: list[float] = Field(description="Lower end of the coverage's confidence interval")
    coverage_high: list[float] = Field(description="Its upper end")


class Version(BaseModel):
    """An immutable trained version."""

    model: str
    version: int
    created_at: str
    job: str | None = Field(description="The job that made it; null for one that was imported or came with LIPServe")
    estimator: str
    joint_names: list[str]
    joint_types: list[JointType]
    torque_convention: TorqueConvention
    noise_std: list[float] = Field(description="Standard deviation of the measured torque, N·m")
    training_range: dict[str, dict[str, list[float]]] = Field(description="Where the samples lie that it stands on")
    options: dict[str, Any]
    fit: dict[str, Any] = Field(description="What the fit reported")
    compact: dict[str, Any] = Field(
        description="Size of the served posterior, and how far it deviates from the exact one: `mean_rms`, `mean_max`, "
        "`std_max` in standard deviations of the function, at `queries` motions"
    )
    calibration: dict[str, Any] = Field(
        description="`function_std_factor`: what `tau_std` was multiplied by so that intervals hold on unseen motion"
    )
    conformal: dict[str, Any] | None = Field(
        None,
        description="What `blocks` of the training, left out in turn, say of its intervals: `scale`, the factor on the "
        "half width of each joint's, and `guaranteed`, the share of measurements that they hold then, at least; null "
        "for the shipped model",
    )
    hyperparameters: dict[str, Any] = Field(description="Hyperparameters by name, mostly logarithms")
    warnings: list[str] = Field(
        description="What to be careful with: what the recording leaves open of a learnt arm, and how its fit ended"
    )
    lineage: dict[str, Any] = Field(
        description="Data sets with their hashes, when and with which `software` it was trained, and how well it fits "
        "them (`training_metrics`); also the version of another unit that it started from (`base`), and of an imported "
        "version where it comes from (`imported`)"
    )
    promotion: Promotion | None = Field(
        None, description="Whether it answers by itself; null for one that was refreshed or shipped"
    )
    selection: Selection | None = Field(
        None, description="How the estimator was chosen; null where it was named when the training was asked for"
    )
    robot: dict[str, Any] | None = Field(None, description="The URDF of an estimator with rigid bodies, and its prior")
    parameters: dict[str, Any] = Field(
        description="`friction`; of rigid bodies also `inertia`, `rotor` and `geometry`, with standard deviations and "
        "with what torque does not tell (`undetermined`). `geometry.joints` run from base to tip, `geometry.order` "
        "names the model's joint at each place; all else is in the order of the model's joints",
    )


class VersionSummary(BaseModel):
    """A version in the list of its model."""

    version: int
    created_at: str
    estimator: str
    quality: HeldOutQuality | None = Field(
        None, description="On what its training held out; null where that was nothing"
    )
    promotion: Promotion | None = Field(
        None, description="Whether it answers by itself, and why; null for one that was refreshed or shipped"
    )


class Model(BaseModel):
    """A named model. Queries are answered by the version that serves unless they name another."""

    name: str
    created_at: str
    latest_version: int = Field(description="The newest version")
    serving_version: int | None = Field(
        description="The version that answers where none is named; null where all wait as candidates"
    )
    aliases: dict[str, int] = Field(description="Names that were given to versions, `serving` aside")
    versions: list[VersionSummary]


class ModelPage(BaseModel):
    """One page of models, newest first."""

    items: list[Model]
    next_cursor: str | None


class AliasRequest(BaseModel):
    """Where an alias shall point: to a version, or to where another alias points now."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"examples": [{"version": 2}, {"alias": "candidate"}]}
    )

    version: VersionNumber | None = Field(None, description="A version of the model")
    alias: AliasName | None = Field(None, description="Another alias of the model, instead of a number")


class AliasMove(BaseModel):
    """One move of an alias."""

    version: int | None = Field(description="Where to; null where the alias was removed")
    before: int | None = Field(description="Where from; null where the alias was new")
    at: str
    rollback: bool = Field(description="Whether it took back an earlier move")


class Alias(BaseModel):
    """A name of a version, which can be moved to another one."""

    alias: str
    version: int
    changed_at: str
    previous: int | None = Field(description="Where a rollback would lead; null where there is nothing to go back to")
    history: list[AliasMove] = Field(description="The last moves, newest first")


class AliasList(BaseModel):
    """Every alias of a model, `serving` first; all are on one page."""

    items: list[Alias]
    next_cursor: None = None


_DEFAULTS = Split()


HoldoutKind = Literal["auto", "stretches", Kind]
"""How a part is chosen to be held out; `auto` looks at the motion, `stretches` are named."""
Row = Annotated[int, Field(ge=0, lt=2**63)]
Stretch = Annotated[list[Row], Field(min_length=2, max_length=2)]
"""Rows of a data set in order of episode and time: the first, and the last, exclusive."""


class Holdout(BaseModel):
    """Part of the data that the version is judged on before it learns it: never rows at random."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{"share": 0.3}]})

    kind: HoldoutKind = Field(
        "auto",
        description="Of each data set: whole `episodes`, chosen by the seed; its `last` part; some of many equal "
        "`blocks`, chosen by the seed; or `auto`, the last part, unless that repeats motion that is learnt from and "
        "there are periods, episodes or stretches of motion that do not: then some of these, chosen by the seed. Of "
        "several data sets of one episode each, `episodes` holds out whole data sets. `stretches`: rows that are named",
    )
    share: float = Field(
        _DEFAULTS.share, gt=0, lt=1, description="Of the samples, as nearly as whole episodes or blocks allow"
    )
    blocks: int = Field(_DEFAULTS.blocks, ge=2, le=1000, description="Equal stretches that `blocks` chooses from")
    guard_s: float | None = Field(
        None,
        ge=0,
        le=3600,
        description="Samples as near as that to the other side are left out of both, s; by default one period of the "
        "low-pass that the data set was prepared with. Of a data set without times 25 samples are",
    )
    seed: int = Field(_DEFAULTS.seed, ge=0, lt=2**31, description="Of the choice")
    stretches: dict[str, Annotated[list[Stretch], Field(min_length=1, max_length=1000)]] | None = Field(
        None,
        max_length=10_000,
        description="With `kind` `stretches`: by the ids of data sets, which rows to hold out, first and last "
        "(exclusive) in order of episode and time. Data sets that are not named are learnt from",
        exclude_if=lambda value: value is None,  # lineages written before there were any compare as equal
    )
    only: bool = Field(
        False,
        description="Whether the version never learns these samples. By default it is judged without them, and then "
        "trained on all samples",
        exclude_if=lambda value: not value,  # as above
    )


class HeldOutSet(BaseModel):
    """What was held out of one data set: enough to find the same samples again."""

    model_config = ConfigDict(strict=True)

    id: str = Field(max_length=40)
    sha256: str = Field(max_length=64)
    whole: bool = Field(description="Whether all of it was held out")
    guard: float = Field(ge=0, description="See `guard_unit`")
    guard_unit: Literal["s", "rows"]
    rows: int = Field(ge=1, lt=2**63, description="Samples held out")
    guarded: int = Field(ge=0, lt=2**63, description="Samples left out of both sides")
    stretches: list[Stretch] | None = Field(
        None,
        max_length=1000,
        description="Which rows these were before the guard, first and last exclusive, in order of episode and "
        "time; null where the split alone says it",
    )


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


class Evaluation(BaseModel):
    """How well torques of a data set, or of part of it, were predicted, per joint."""

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
    independent: list[float] = Field(
        description="Independent errors that the coverage stands on: neighbouring ones tell the same"
    )
    coverage_low: list[float] = Field(description="Lower end of the coverage's 95 % confidence interval, from these")
    coverage_high: list[float] = Field(description="Its upper end: where it is below 0.9, intervals are too narrow")
    repeats_training: float | None = Field(
        description="Share of the samples whose motion (position, velocity and acceleration) repeats what the version "
        "was trained on, so that figures flatter; null where it was trained on these samples, and where its data sets "
        "are gone"
    )
    period_s: float | None = Field(description="Time after which that motion repeats itself, s; null where it does not")
    warnings: list[str] = Field(description="What else makes the figures flatter")


class HeldOutBlocks(BaseModel):
    """Scores of the judged fit in blocks of the samples held out: a later version is compared with them, see
    `lipcore.data.metrics.BlockScores`."""

    model_config = ConfigDict(strict=True)

    rows: list[Annotated[int, Field(ge=1, lt=2**63)]] = Field(min_length=1, description="Of each block")
    nlpd: list[FiniteFloat] = Field(description="Sum over these rows of the negative log density of all joints, nats")
    nmse: list[FiniteFloat | None] = Field(description="Sum over these rows of squared error / variance of the torque")

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        if not len(self.rows) == len(self.nlpd) == len(self.nmse):
            raise ValueError("rows, nlpd and nmse differ in length")
        return self


class HoldoutLineage(BaseModel):
    """What a version's lineage says of it; the figures that go with it are shown and not read.

    The figures are those of the judged fit, which was trained without the samples held out.
    """

    model_config = ConfigDict(strict=True)

    split: Holdout
    datasets: list[HeldOutSet] = Field(min_length=1, max_length=10_000)
    rows: int = Field(ge=1, lt=2**63)
    guarded: int = Field(ge=0, lt=2**63)
    learnt: bool = Field(False, description="Whether the version was trained on these samples after it was judged")
    judged_rows: int | None = Field(None, ge=0, lt=2**63, description="Samples that the judged fit was trained on")
    evaluations: dict[str, Evaluation] = Field(
        {}, max_length=10_000, description="By data set, if `learnt`: how the judged fit predicts what was held out"
    )
    blocks: HeldOutBlocks | None = Field(None, description="If `learnt`: what a later version is compared with")
