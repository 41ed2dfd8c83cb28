"""Models, versions and aliases."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, field_validator

from lipcore.vocabulary import ComponentName, JointType, TorqueConvention
from service.contract.body import RequestBody
from service.contract.states import PromotionOption
from service.contract.verdict import Thresholds, Verdict

ModelName = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")]
"""Lower-case letters, digits, dots, underscores and hyphens: safe in URLs and never a path."""
VersionNumber = Annotated[int, Field(ge=1, lt=2**31)]
ALIAS = r"^[a-z][a-z0-9._-]{0,63}$"
VERSION = r"^[a-z0-9][a-z0-9._-]{0,63}([:@][1-9][0-9]{0,8}|@[a-z][a-z0-9._-]{0,63})?$"
"""A version in one text: `model@3`, `model@alias`, or `model` for the serving version. Jobs keep it as `model:3`."""
AliasName = Annotated[str, StringConstraints(pattern=ALIAS)]
"""A letter, then lower-case letters, digits, dots, underscores and hyphens: never a version number."""


def _check_printable(text: str) -> str:
    if not text.replace("\n", "").isprintable():
        raise ValueError("only printable characters and line ends")
    return text


Note = Annotated[str, StringConstraints(max_length=500, strip_whitespace=True), AfterValidator(_check_printable)]
Tag = Annotated[str, StringConstraints(max_length=40, strip_whitespace=True, pattern=r"^[^,\n]+$")]
Tags = Annotated[list[Annotated[Tag, AfterValidator(_check_printable)]], Field(max_length=10)]


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
    """Whether a new version became the serving version, and why."""

    answers: bool = Field(description="Whether it started to serve after training; else it got the alias `candidate`")
    serving: int | None = Field(description="Serving version until then; null if there was none")
    reason: str

    @classmethod
    def of(cls, serves: bool, reason: str, serving: int | None, option: PromotionOption = "ask") -> Promotion:
        """Decide whether a version serves: if it may, or if its owner always promotes."""
        if not serves and option == "always":
            reason += " It serves, because `promotion` is always."
        return cls(answers=serves or option == "always", serving=serving, reason=reason)


class Version(BaseModel):
    """An immutable, trained version."""

    model: str
    version: int
    created_at: str
    job: str | None = Field(description="Job that trained it; null for an imported or shipped version")
    note: str | None = Field(None, description="Note on the version, as set by a user")
    tags: list[str] = Field([], description="Tags of the version, as set by a user")
    estimator: str
    components: list[ComponentName] = Field(description="Components of the torque that it offers")
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
    verdict: Verdict
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
    note: str | None = Field(None, description="Note on the version, as set by a user")
    tags: list[str] = Field([], description="Tags of the version, as set by a user")
    estimator: str
    verdict: Verdict
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
    thresholds: Thresholds = Field(description="Thresholds of the verdicts")
    versions: list[VersionSummary]


class ModelPage(BaseModel):
    """One page of models, newest first."""

    items: list[Model]
    next_cursor: str | None


class Annotation(RequestBody):
    """Note and tags of a version. Omitted fields stay; null or an empty value removes them."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"note": "new gripper", "tags": ["line 2"]}]})

    note: Note | None = Field(None, description="Text of at most 500 characters")
    tags: Tags | None = Field(None, description="At most 10 tags of at most 40 characters, without commas")

    @field_validator("note", "tags")
    @classmethod
    def _normalise(cls, value: Any) -> Any:
        """Read empty values as null, and a repeated tag as one."""
        return (list(dict.fromkeys(value)) if isinstance(value, list) else value) or None


class AliasRequest(RequestBody):
    """Target of an alias: a version, or the present target of another alias."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"version": 2}, {"alias": "candidate"}]})

    version: VersionNumber | None = Field(None, description="A version of the model")
    alias: AliasName | None = Field(None, description="Another alias of the model, instead of a version")
    override: bool = Field(False, description="Move the alias whatever the verdict on the version")


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
