"""Training jobs. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.models import HeldOutQuality


class Holdout(Record, frozen=True, kw_only=True):
    """Part of the data that the version is judged on before it learns it: never rows at random.

    kind: Of each data set: whole `episodes`, chosen by the seed; its `last` part; some of many equal `blocks`, chosen
        by the seed; or `auto`, the last part, unless that repeats motion that is learnt from and there are periods,
        episodes or stretches of motion that do not: then some of these, chosen by the seed. Of several data sets of one
        episode each, `episodes` holds out whole data sets. `stretches`: rows that are named
    share: Of the samples, as nearly as whole episodes or blocks allow
    blocks: Equal stretches that `blocks` chooses from
    guard_s: Samples as near as that to the other side are left out of both, s; by default one period of the low-pass
        that the data set was prepared with. Of a data set without times 25 samples are
    seed: Of the choice
    stretches: With `kind` `stretches`: by the ids of data sets, which rows to hold out, first and last (exclusive) in
        order of episode and time. Data sets that are not named are learnt from
    only: Whether the version never learns these samples. By default it is judged without them, and then trained on all
        samples
    """

    kind: Literal["auto", "stretches", "episodes", "last", "blocks"] = "auto"
    share: float = 0.3
    blocks: int = 10
    guard_s: float | None = None
    seed: int = 0
    stretches: dict[str, list[list[int]]] | None = None
    only: bool = False


class Refresh(Record, frozen=True, kw_only=True):
    """A job that trains a version anew on the data of an earlier one and what has been observed since.

    version: The version that is refreshed
    through: Last event of the model's log that it learns from
    trigger: Why: much of the motion was beyond what the version knows, its learnt arm had left where its torque is
        linear, or somebody asked for it
    """

    version: int
    through: int
    trigger: Literal["novelty", "linearisation", "asked"]


class JobProgress(Record, frozen=True, kw_only=True):
    """How far a job is.

    stage: waiting, loading, geometry, hyperparameters, posterior, statistics, evaluating, all_rows, saving or done.
        `all_rows` is the last fit, on the rows held out, too
    estimator: The one at work, where `auto` trains several
    objective: Penalised negative log evidence, nats: falls during the fit
    remaining_s: Roughly the seconds that are left; null until that can be told. Taken to need all iterations, though a
        fit often converges earlier
    """

    stage: str
    estimator: str | None = None
    iteration: int = 0
    max_iterations: int = 0
    objective: float | None = None
    fraction: float = 0.0
    elapsed_s: float = 0.0
    remaining_s: float | None = None


class JobError(Record, frozen=True, kw_only=True):
    """Why a job failed."""

    code: str
    message: str


class JobChange(Record, frozen=True, kw_only=True):
    """One thing that happened to a job.

    state: From then on
    """

    at: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    message: str


class Job(Record, frozen=True, kw_only=True):
    """A training job.

    robot: Profile or id of an uploaded URDF, of estimators with rigid bodies
    base: The version that it starts from, as `model:3`
    holdout: What it holds out of the data sets; a refresh holds out what its version held out
    promotion: What was asked for; the version's `promotion` says what came of it
    refresh: What it refreshes; null for a job with data sets alone
    attempts: Times it was started; more than one after an interruption
    version: The version it made, once succeeded
    quality: Of that version, on what the job held out; null where that is nothing
    heartbeat_at: When the training process last said that it lives
    history: What happened to it, oldest first
    retry_of: The job that it repeats
    request_id: Id of the request that queued it, as the service's log names it
    """

    id: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    model: str
    estimator: str
    robot: str | None
    base: str | None = None
    datasets: list[str]
    holdout: Holdout | None = None
    promotion: Literal["ask", "always"] | None = None
    refresh: Refresh | None = None
    progress: JobProgress
    attempts: int
    version: int | None
    quality: HeldOutQuality | None = None
    error: JobError | None
    created_at: str
    started_at: str | None
    heartbeat_at: str | None
    finished_at: str | None
    history: list[JobChange]
    retry_of: str | None
    request_id: str | None
