"""Training jobs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from lipcore.estimators.options import MAX_SEARCH_SECONDS, FitOptions, GeometryOption, Standing
from lipcore.vocabulary import AUTO, ESTIMATOR_CHOICES, ROBOT_ESTIMATORS, TORCH_ESTIMATORS, JointType
from service.contract.body import RequestBody
from service.contract.holdout import Holdout
from service.contract.models import VERSION, ModelName
from service.contract.states import JobState, PromotionOption
from service.contract.verdict import Verdict
from service.foundation.fields import MAX_NAME_CHARS, MAX_NAMES

MAX_OPTIONS = {"hyperparameter_samples": 500, "posterior_samples": 1000, "max_inducing_outputs": 4000}
"""Max values of fit options. Fit time grows with the cube of the samples, prediction time with the outputs."""
_DEFAULTS, _HOLDOUT = FitOptions(), Holdout()


class Options(RequestBody):
    """Options of the fit. The defaults suit most recordings."""

    hyperparameter_samples: int = Field(
        _DEFAULTS.hyperparameter_samples, ge=10, description="Samples for the fit of the hyperparameters"
    )
    posterior_samples: int = Field(
        _DEFAULTS.posterior_samples, ge=10, description="Samples in the posterior; of more, the most spread-out ones"
    )
    max_iterations: int = Field(_DEFAULTS.max_iterations, ge=1, le=10_000)
    starts: int = Field(
        _DEFAULTS.starts,
        ge=1,
        le=20,
        description="Starting points of the search; the one with the best evidence is continued",
    )
    tied: bool = Field(
        _DEFAULTS.tied,
        description="For `lip`: all links share kernel shapes. False: each link has its own, as in the paper",
    )
    prior: Literal["urdf", "zero"] = Field(
        "urdf", description="For rigid bodies: prior inertial parameters, from the URDF or zero"
    )
    geometry: GeometryOption = Field(
        _DEFAULTS.geometry,
        description="For rigid bodies, the geometry of the joint axes: `learn` from torque alone, `calibrate` around "
        "the robot's URDF or `base`, or `fixed` to it; `auto`: calibrate if there is one, else learn",
    )
    arms: str = Field(
        _DEFAULTS.arms,
        max_length=400,
        description="For rigid bodies without a robot: the number of joints of each of several arms on one fixed base, "
        "such as `7,7`, from base to tip, arm after arm in the order of the data. A robot's URDF has its arms itself",
    )
    search_seconds: float = Field(
        _DEFAULTS.search_seconds,
        gt=0,
        le=MAX_SEARCH_SECONDS,
        description="Max processor time of the search for a geometry, s",
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto",
        description=f"Only {', '.join(TORCH_ESTIMATORS)} use a GPU: `auto` uses one if available, `cuda` requires one",
    )
    compact_tolerance: float = Field(
        _DEFAULTS.compact_tolerance,
        gt=0,
        le=1,
        description="Max deviation of the served posterior from the exact one, in its standard deviations",
    )
    max_inducing_outputs: int = Field(
        _DEFAULTS.max_inducing_outputs,
        ge=1,
        description="Max inducing outputs; more make predictions slower. If the tolerance needs more, `compact` of the "
        "version has the deviation",
    )
    statistics: Standing = Field(
        _DEFAULTS.statistics,
        description="Samples of the final posterior: the `chosen` ones, or `all`, each weighted by the time it "
        "represents; `auto`: all, if they have more than `posterior_samples` effective samples",
    )


DatasetName = Annotated[str, Field(max_length=MAX_NAME_CHARS)]


class JobRequest(RequestBody):
    """A model to train, its data sets and options."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"model": "my-panda", "datasets": ["ds_0123456789abcdef"]}]},
    )

    model: ModelName = Field(description="Name of the model, which gets a new version")
    datasets: list[DatasetName] = Field(min_length=1, max_length=MAX_NAMES, description="Ids or names of data sets")
    estimator: str = Field(
        AUTO,
        max_length=40,
        description=f"One of {', '.join(ESTIMATOR_CHOICES)}; `auto` compares arms and `lip-chain` on held-out rows and "
        "chooses the simplest unless another one is clearly better",
    )
    joint_types: list[JointType] | None = Field(
        None,
        max_length=MAX_NAMES,
        description="One per joint; by default those of the data set's robot, else revolute",
    )
    robot: str | None = Field(
        None,
        max_length=40,
        description=f"For {', '.join(ROBOT_ESTIMATORS)} and {AUTO}: a profile such as panda, or the id of a URDF. By "
        "default the robot of the data sets, if it has a URDF with their joints; null: none",
    )
    base: str | None = Field(
        None,
        pattern=VERSION,
        description="Version of another unit of the same robot to start from: `model@3`, `model@alias`, or `model` for "
        f"the serving version. For {', '.join(ROBOT_ESTIMATORS)} and {AUTO}. Its arm is the prior, its friction is "
        f"not. "
        "It can be deleted after the job",
    )
    options: Options = Field(default_factory=Options)
    holdout: Holdout | None = Field(
        default_factory=Holdout,
        description="Part of the data sets to hold out for the evaluation; its figures are in the version's lineage. "
        "The version is then trained on all samples, unless `only` is true. "
        f"By default {100 * _HOLDOUT.share:.0f} %, chosen by `{_HOLDOUT.kind}`; null: nothing",
    )
    promotion: PromotionOption | None = Field(
        None,
        description="When the version becomes the serving version. `ask`: if coverage on the held-out part is at least "
        "90 % on every joint, within sampling error, and it is not worse than the serving version; else it gets the "
        "alias `candidate`. `always`: in any case. By default the setting LIPSERVE_PROMOTION",
    )


class JobDraft(JobRequest):
    """A draft of a job, possibly before its recordings are uploaded."""

    datasets: list[DatasetName] = Field(
        [],
        max_length=MAX_NAMES,
        description="Data sets that are already uploaded; without any, checks that need data are skipped",
    )


class JobProgress(BaseModel):
    """Progress of a job."""

    stage: str = Field(
        description="waiting, loading, geometry, hyperparameters, posterior, statistics, evaluating, learning_curve, "
        "all_rows, saving or done. `all_rows` is the final fit, held-out rows included"
    )
    estimator: str | None = Field(None, description="Estimator in training, if `auto` trains several")
    iteration: int = 0
    max_iterations: int = 0
    objective: float | None = Field(None, description="Penalised negative log evidence, nats; decreases during the fit")
    fraction: float = Field(0.0, ge=0, le=1)
    elapsed_s: float = 0.0
    remaining_s: float | None = Field(
        None,
        description="Estimated remaining time, s; null until it is known. It assumes all iterations, but fits often "
        "converge earlier",
    )


class JobChange(BaseModel):
    """One change of a job's state."""

    at: str
    state: JobState = Field(description="New state")
    message: str


class JobError(BaseModel):
    """Why a job failed."""

    code: str
    message: str


class Refresh(BaseModel):
    """Refresh: a job that retrains a version on its data and later observations."""

    version: int = Field(description="Version to refresh")
    through: int = Field(description="Last event of the model's log that is used")
    trigger: Literal["novelty", "linearisation", "asked"] = Field(
        description="Reason: `novelty`, much motion outside the known region; `linearisation`, the learnt arm drifted "
        "past its linearisation; `asked`, a request"
    )


class Job(BaseModel):
    """A training job."""

    id: str
    state: JobState
    model: str
    estimator: str
    robot: str | None = Field(description="Profile or id of an uploaded URDF, for estimators with rigid bodies")
    base: str | None = Field(None, description="Version that it starts from, as `model:3`")
    datasets: list[str]
    holdout: Holdout | None = Field(
        None, description="Held-out part of the data sets; a refresh uses that of its version"
    )
    promotion: PromotionOption | None = Field(
        None, description="Requested promotion; `promotion` of the version has the outcome"
    )
    refresh: Refresh | None = Field(None, description="Refreshed version; null for a job with data sets only")
    progress: JobProgress
    attempts: int = Field(description="Number of starts; more than one after an interruption")
    version: int | None = Field(description="Version that the job made; null unless it succeeded")
    verdict: Verdict | None = Field(None, description="Verdict on that version; null without one")
    error: JobError | None
    created_at: str
    started_at: str | None
    heartbeat_at: str | None = Field(description="Time of the training process's last heartbeat")
    finished_at: str | None
    history: list[JobChange] = Field(description="State changes, oldest first")
    retry_of: str | None = Field(description="Job that this one repeats; null if none")
    request_id: str | None = Field(description="Id of the request that queued it, as in the service's log")


class JobPage(BaseModel):
    """One page of jobs, newest first."""

    items: list[Job]
    next_cursor: str | None
