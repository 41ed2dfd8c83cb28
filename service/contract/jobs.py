"""Training jobs as the API takes and shows them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from lipcore.estimators.options import MAX_SEARCH_SECONDS, FitOptions, GeometryOption, Standing
from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES, ROBOT_ESTIMATORS, TORCH_ESTIMATORS, JointType
from service.contract.models import VERSION, HeldOutQuality, Holdout, ModelName
from service.contract.states import JobState, PromotionOption
from service.foundation.fields import MAX_NAME_CHARS, MAX_NAMES

MAX_OPTIONS = {"hyperparameter_samples": 500, "posterior_samples": 1000, "max_inducing_outputs": 4000}
"""Max values of options of a fit. Its time grows with the cube of the samples, that of an answer with the outputs."""
_DEFAULTS, _HOLDOUT = FitOptions(), Holdout()


class Options(BaseModel):
    """How to fit; the defaults suit most recordings."""

    model_config = ConfigDict(extra="forbid", strict=True)

    hyperparameter_samples: int = Field(
        _DEFAULTS.hyperparameter_samples, ge=10, description="Samples that hyperparameters are fitted on"
    )
    posterior_samples: int = Field(
        _DEFAULTS.posterior_samples, ge=10, description="Samples the model stands on: of more, the most spread-out"
    )
    max_iterations: int = Field(_DEFAULTS.max_iterations, ge=1, le=10_000)
    starts: int = Field(
        _DEFAULTS.starts, ge=1, le=20, description="Points the search is tried from; the best by evidence is followed"
    )
    tied: bool = Field(_DEFAULTS.tied, description="Of `lip`: links share kernel shapes; false is the paper's form")
    prior: Literal["urdf", "zero"] = Field(
        "urdf", description="Of rigid bodies: expect the URDF's inertial parameters, or none"
    )
    geometry: GeometryOption = Field(
        _DEFAULTS.geometry,
        description="Of rigid bodies, where the joint axes lie: `learn` from torque alone, `calibrate` around the "
        "robot's URDF or the base, `fixed` as that has it; `auto`: calibrate where there is one, else learn",
    )
    search_seconds: float = Field(
        _DEFAULTS.search_seconds, gt=0, le=MAX_SEARCH_SECONDS, description="Time limit of the search for a geometry, s"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description=f"Only {', '.join(TORCH_ESTIMATORS)} use a GPU: `auto` if there is one, `cuda` always"
    )
    compact_tolerance: float = Field(
        _DEFAULTS.compact_tolerance,
        gt=0,
        le=1,
        description="Largest deviation of the served posterior from the exact one, in its standard deviations",
    )
    max_inducing_outputs: int = Field(
        _DEFAULTS.max_inducing_outputs,
        ge=1,
        description="Most inducing outputs, which answers take the longer for; with fewer than the tolerance needs, "
        "the version's `compact` says how far it deviates",
    )
    statistics: Standing = Field(
        _DEFAULTS.statistics,
        description="What the posterior stands on in the end: the samples that were `chosen`, or `all`, each for the "
        "time that it stands for; `auto`: all, where that is worth more than `posterior_samples` independent ones",
    )


DatasetName = Annotated[str, Field(max_length=MAX_NAME_CHARS)]


class JobRequest(BaseModel):
    """What to train on what."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        json_schema_extra={"examples": [{"model": "my-panda", "datasets": ["ds_0123456789abcdef"]}]},
    )

    model: ModelName = Field(description="Name of the model; a new version of it is made")
    datasets: list[DatasetName] = Field(min_length=1, max_length=MAX_NAMES, description="Ids or names of data sets")
    estimator: str = Field(
        AUTO,
        max_length=40,
        description=f"One of {', '.join(ESTIMATOR_CHOICES)}; `auto` compares arms and `lip-chain` on held-out rows and "
        "takes the simplest unless another one is surely better",
    )
    joint_types: list[JointType] | None = Field(
        None,
        max_length=MAX_NAMES,
        description="One a joint; by default those of the robot that a data set was uploaded with, else revolute",
    )
    robot: str | None = Field(
        None,
        max_length=40,
        description=f"For {', '.join(ROBOT_ESTIMATORS)} and {AUTO}: a profile such as panda, or the id of a URDF",
    )
    base: str | None = Field(
        None,
        pattern=VERSION,
        description="Version of another unit of the same robot to start from: `model:3`, `model@alias`, or `model` for "
        f"the one that serves. For {', '.join(ROBOT_ESTIMATORS)} and {AUTO}; its arm is expected, friction is not. It "
        "may be deleted after the job",
    )
    options: Options = Field(default_factory=Options)
    holdout: Holdout | None = Field(
        default_factory=Holdout,
        description="What to hold out of the data sets, to judge the version on: its lineage keeps the figures. The "
        f"version is then trained on all samples, unless `only` is true. By default {100 * _HOLDOUT.share:.0f} %, as "
        f"`{_HOLDOUT.kind}` chooses; null: nothing",
    )
    promotion: PromotionOption | None = Field(
        None,
        description="Whether the version answers by itself: `ask`, if on what was held out its 95 % intervals hold "
        "90 % on every joint, as far as can be told, and it is not worse than the version that serves, else it waits "
        "under the alias `candidate`; `always`, in any case. The setting LIPSERVE_PROMOTION by default",
    )


class JobDraft(JobRequest):
    """What somebody means to train on what, maybe on recordings that are not uploaded yet."""

    datasets: list[DatasetName] = Field(
        [],
        max_length=MAX_NAMES,
        description="Those that are there already; without any, what depends on the data is not checked",
    )


class JobProgress(BaseModel):
    """How far a job is."""

    stage: str = Field(
        description="waiting, loading, geometry, hyperparameters, posterior, statistics, evaluating, all_rows, saving "
        "or done. `all_rows` is the last fit, on the rows held out, too"
    )
    estimator: str | None = Field(None, description="The one at work, where `auto` trains several")
    iteration: int = 0
    max_iterations: int = 0
    objective: float | None = Field(None, description="Penalised negative log evidence, nats: falls during the fit")
    fraction: float = Field(0.0, ge=0, le=1)
    elapsed_s: float = 0.0
    remaining_s: float | None = Field(
        None,
        description="Roughly the seconds that are left; null until that can be told. Taken to need all iterations, "
        "though a fit often converges earlier",
    )


class JobChange(BaseModel):
    """One thing that happened to a job."""

    at: str
    state: JobState = Field(description="From then on")
    message: str


class JobError(BaseModel):
    """Why a job failed."""

    code: str
    message: str


class Refresh(BaseModel):
    """A job that trains a version anew on the data of an earlier one and what has been observed since."""

    version: int = Field(description="The version that is refreshed")
    through: int = Field(description="Last event of the model's log that it learns from")
    trigger: Literal["novelty", "linearisation", "asked"] = Field(
        description="Why: much of the motion was beyond what the version knows, its learnt arm had left where its "
        "torque is linear, or somebody asked for it"
    )


class Job(BaseModel):
    """A training job."""

    id: str
    state: JobState
    model: str
    estimator: str
    robot: str | None = Field(description="Profile or id of an uploaded URDF, of estimators with rigid bodies")
    base: str | None = Field(None, description="The version that it starts from, as `model:3`")
    datasets: list[str]
    holdout: Holdout | None = Field(
        None, description="What it holds out of the data sets; a refresh holds out what its version held out"
    )
    promotion: PromotionOption | None = Field(
        None, description="What was asked for; the version's `promotion` says what came of it"
    )
    refresh: Refresh | None = Field(None, description="What it refreshes; null for a job with data sets alone")
    progress: JobProgress
    attempts: int = Field(description="Times it was started; more than one after an interruption")
    version: int | None = Field(description="The version it made, once succeeded")
    quality: HeldOutQuality | None = Field(
        None, description="Of that version, on what the job held out; null where that is nothing"
    )
    error: JobError | None
    created_at: str
    started_at: str | None
    heartbeat_at: str | None = Field(description="When the training process last said that it lives")
    finished_at: str | None
    history: list[JobChange] = Field(description="What happened to it, oldest first")
    retry_of: str | None = Field(description="The job that it repeats")
    request_id: str | None = Field(description="Id of the request that queued it, as the service's log names it")


class JobPage(BaseModel):
    """One page of jobs, newest first."""

    items: list[Job]
    next_cursor: str | None
