"""Training jobs. Written by `python clients/python/records.py`."""

from __future__ import annotations

from typing import Literal

from lipserve.records import Record
from lipserve.records.verdicts import Verdict


class Holdout(Record, frozen=True, kw_only=True):
    """Part of the data that is held out to evaluate a version: contiguous rows, not random ones.

    kind: Held-out part of each data set. `last`: its last part. `episodes`: whole episodes, chosen by the seed; of
        several data sets with one episode each, whole data sets. `blocks`: some of many equal blocks, chosen by the
        seed. `auto`: the last part, unless that repeats motion of the training part and other periods, episodes or
        stretches do not; then some of these, chosen by the seed. `stretches`: the given rows
    share: Share of the samples, as closely as whole episodes or blocks allow
    blocks: Number of equal blocks from which `blocks` chooses
    guard_s: Samples closer than this to the other part are in neither part, s; by default one period of the data set's
        low-pass. In a data set without times, 25 samples
    seed: Seed of the random choice
    stretches: For `kind` `stretches`: rows to hold out by data set id, first and last (exclusive), in order of episode
        and time. Other data sets are used for training only
    only: Whether the version is never trained on these samples. By default it is evaluated without them and then
        trained on all samples
    """

    kind: Literal["auto", "stretches", "episodes", "last", "blocks"] = "auto"
    share: float = 0.3
    blocks: int = 10
    guard_s: float | None = None
    seed: int = 0
    stretches: dict[str, list[list[int]]] | None = None
    only: bool = False


class Refresh(Record, frozen=True, kw_only=True):
    """Refresh: a job that retrains a version on its data and later observations.

    version: Version to refresh
    through: Last event of the model's log that is used
    trigger: Reason: `novelty`, much motion outside the known region; `linearisation`, the learnt arm drifted past its
        linearisation; `asked`, a request
    """

    version: int
    through: int
    trigger: Literal["novelty", "linearisation", "asked"]


class JobProgress(Record, frozen=True, kw_only=True):
    """Progress of a job.

    stage: waiting, loading, geometry, hyperparameters, posterior, statistics, evaluating, learning_curve, all_rows,
        saving or done. `all_rows` is the final fit, held-out rows included
    estimator: Estimator in training, if `auto` trains several
    objective: Penalised negative log evidence, nats; decreases during the fit
    remaining_s: Estimated remaining time, s; null until it is known. It assumes all iterations, but fits often converge
        earlier
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
    """One change of a job's state.

    state: New state
    """

    at: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"]
    message: str


class Job(Record, frozen=True, kw_only=True):
    """A training job.

    robot: Profile or id of an uploaded URDF, for estimators with rigid bodies
    base: Version that it starts from, as `model:3`
    holdout: Held-out part of the data sets; a refresh uses that of its version
    promotion: Requested promotion; `promotion` of the version has the outcome
    refresh: Refreshed version; null for a job with data sets only
    attempts: Number of starts; more than one after an interruption
    version: Version that the job made; null unless it succeeded
    verdict: Verdict on that version; null without one
    heartbeat_at: Time of the training process's last heartbeat
    history: State changes, oldest first
    retry_of: Job that this one repeats; null if none
    request_id: Id of the request that queued it, as in the service's log
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
    verdict: Verdict | None = None
    error: JobError | None
    created_at: str
    started_at: str | None
    heartbeat_at: str | None
    finished_at: str | None
    history: list[JobChange]
    retry_of: str | None
    request_id: str | None
