"""Routes of online learning: quality, observation batches, options, decisions, payloads and alarms."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from service.api.access.scopes import ADMIN, READ, TRAIN, UPDATE, needs
from service.api.dependencies import JobQueueDep, LearnersDep, PageQuery
from service.api.errors import responses
from service.api.route import Route
from service.contract import learning as schema
from service.contract.jobs import Job
from service.contract.observations import MAX_SEQUENCE, LearningOptions, StreamId
from service.contract.overview import OverviewPage
from service.contract.payload import PAYLOAD_EXAMPLE, PayloadRequest, Payloads
from service.foundation.errors import (
    BusyError,
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnreadableVersionError,
)
from service.learning.control import decisions, overview, payload, status
from service.training import jobs

Sequence = Annotated[int, Path(ge=0, le=MAX_SEQUENCE)]
EXAMPLE = {"forgetting_s": 3600.0, "on_change": "hold", "contact_threshold": 8.0}
BATCH = "/{model}/observations/{stream_id}/{sequence}"

router = APIRouter(
    prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError, NotFoundError), route_class=Route
)


overview_router = APIRouter(
    prefix="/v1/overview", tags=["learning"], responses=responses(InvalidRequestError), route_class=Route
)


@overview_router.get("", summary="List models with their key figures, newest first")
@needs(READ)
def show_overview(learners: LearnersDep, page: PageQuery) -> OverviewPage:
    """Return one page of models, each with the figures that a dashboard card shows. No model is loaded.

    These are the learnt arm and its posture, the error and coverage on held-out data and on the last hour of
    observations, the payload, and the newest alarm.
    """
    return overview.list_models(learners, page)


@router.get("/{model}/quality", summary="Retrieve the prediction quality of a model")
@needs(READ)
def show_quality(learners: LearnersDep, model: str) -> schema.Quality:
    """Return error and coverage over sliding windows of observations.

    Every row is predicted and compared with the measurement before it is learnt.
    """
    return status.read_quality(learners, model)


@router.get("/{model}/observations", summary="List observation batches, newest first")
@needs(READ)
def list_observations(
    learners: LearnersDep,
    model: str,
    page: PageQuery,
    stream_id: Annotated[StreamId | None, Query(description="Only batches of this stream")] = None,
    rejected: Annotated[bool, Query(description="Only batches with rejected rows")] = False,
) -> schema.ObservationPage:
    """Return one page of the observation log: every batch, and how many of its rows were learnt or rejected."""
    return status.list_batches(learners, model, page, stream_id, rejected)


@router.get(BATCH, summary="Retrieve an observation batch")
@needs(READ)
def show_observation(
    learners: LearnersDep,
    model: str,
    stream_id: StreamId,
    sequence: Sequence,
    rows: Annotated[bool, Query(description="Include the rows, each with its code")] = False,
) -> schema.ObservationDetail:
    """Return a batch: its first answer, how well it was predicted, and whether it was unlearnt or replayed since."""
    return status.read_batch(learners, model, stream_id, sequence, rows)


@router.delete(BATCH, summary="Unlearn an observation batch", responses=responses(ConflictError))
@needs(UPDATE)
def unlearn(learners: LearnersDep, model: str, stream_id: StreamId, sequence: Sequence) -> schema.Unlearnt:
    """Remove the learnt and replayed rows of a batch from the model, exactly. The batch stays in the log.

    If accelerations are derived from velocities, rows at the edge of a batch are learnt with the neighbouring batch.
    These rows stay learnt.
    """
    return decisions.unlearn(learners, model, stream_id, sequence)


@router.post(
    f"{BATCH}/replay", summary="Learn the rejected rows of a batch", responses=responses(ConflictError, TooLargeError)
)
@needs(UPDATE)
def replay(
    learners: LearnersDep, model: str, stream_id: StreamId, sequence: Sequence, request: schema.ReplayRequest
) -> schema.Replayed:
    """Learn rows of a batch that were rejected. Each row is learnt once.

    Rows with the code `time_jump` get their time of arrival as their time.
    """
    return decisions.replay(learners, model, stream_id, sequence, request)


@router.post(
    "/{model}/rollback",
    summary="Roll back to a revision or a version",
    responses=responses(ConflictError, TooLargeError, UnreadableVersionError),
)
@needs(ADMIN)
def rollback(learners: LearnersDep, model: str, request: schema.RollbackRequest) -> schema.RolledBack:
    """Undo what the serving version learnt after a revision, or make another version the serving version.

    Batches that were unlearnt since then stay unlearnt.
    """
    return decisions.rollback(learners, model, request)


@router.get("/{model}/learning", summary="Retrieve the learning state of a model")
@needs(READ)
def show_learning(learners: LearnersDep, model: str) -> schema.Learning:
    """Return the options, the progress of learning, why it is paused, and the revisions to roll back to."""
    return status.read_learning(learners, model)


@router.put(
    "/{model}/learning",
    summary="Set the learning options of a model",
    responses=responses(TooLargeError),
    openapi_extra={"requestBody": {"content": {"application/json": {"example": EXAMPLE}}}},
)
@needs(ADMIN)
def set_learning(learners: LearnersDep, model: str, options: LearningOptions) -> schema.Learning:
    """Replace all learning options. Omitted options get their defaults. What was learnt before stays learnt."""
    decisions.set_options(learners, model, options)
    return status.read_learning(learners, model)


@router.post(
    "/{model}/learning/change",
    summary="Decide about a detected change of the robot",
    responses=responses(ConflictError, TooLargeError),
)
@needs(ADMIN)
def decide(learners: LearnersDep, model: str, request: schema.ChangeRequest) -> schema.Decided:
    """Resume learning after a detected change: adapt to the changed robot, or ignore the change."""
    return decisions.decide(learners, model, request)


@router.get("/{model}/payload", summary="Retrieve the payloads of a model")
@needs(READ)
def show_payload(learners: LearnersDep, model: str) -> Payloads:
    """Return mass, centre of mass and inertia of the payload of every stream, with their uncertainty.

    Payloads are detected and estimated automatically from the rows of the streams, and included in predictions. This is
    not a safety function.
    """
    return payload.read_payloads(learners, model)


@router.put(
    "/{model}/payload",
    summary="Declare a payload",
    responses=responses(ConflictError, TooLargeError),
    openapi_extra={"requestBody": {"content": {"application/json": {"example": PAYLOAD_EXAMPLE}}}},
)
@needs(UPDATE)
def declare_payload(learners: LearnersDep, model: str, request: PayloadRequest) -> Payloads:
    """Include a known payload in predictions from now on, as in a robot controller's payload setting.

    If later rows contradict the declared payload, the estimate from these rows replaces it.
    """
    return payload.declare(learners, model, request)


@router.delete("/{model}/payload", summary="Declare that there is no payload", responses=responses(ConflictError))
@needs(UPDATE)
def remove_payload(
    learners: LearnersDep,
    model: str,
    stream_id: Annotated[
        StreamId | None, Query(description="The stream of the robot without a payload. Default: all streams")
    ] = None,
) -> Payloads:
    """Predict without a payload from now on."""
    return payload.remove(learners, model, stream_id)


@router.delete(
    "/{model}/streams/{stream_id}", status_code=204, summary="Delete a stream", responses=responses(ConflictError)
)
@needs(UPDATE)
def delete_stream(learners: LearnersDep, model: str, stream_id: StreamId) -> None:
    """Delete a stream with its payload, clock and interval scale.

    What was learnt from the stream stays learnt, and its batches stay in the log. `GET …/learning` lists the streams.
    """
    decisions.delete_stream(learners, model, stream_id)


@router.get("/{model}/alarms", summary="List alarms, newest first")
@needs(READ)
def list_alarms(learners: LearnersDep, model: str, page: PageQuery) -> schema.AlarmPage:
    """Return one page of alarms: changes of the robot, motion outside the training range, and new versions."""
    return decisions.alarms(learners, model, page)


@router.post(
    "/{model}/refresh",
    status_code=202,
    summary="Retrain the serving version",
    responses=responses(NotFoundError, ConflictError, TooLargeError, BusyError),
)
@needs(TRAIN)
def create(queue: JobQueueDep, model: str, request: schema.RefreshRequest, response: Response) -> Job:
    """Queue a job that trains on the version's data sets and on the observations since.

    The new version starts serving if it predicts the newest third of the observations better than the serving version.
    Both predict these observations before learning them.
    """
    job = jobs.refresh(queue, model)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
