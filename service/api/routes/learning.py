"""Routes of what the owner of a learning model sees and decides."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from service.api.access.scopes import ADMIN, READ, TRAIN, UPDATE, needs
from service.api.dependencies import JobQueueDep, LearnersDep, PageQuery
from service.api.errors import responses
from service.api.route import Route
from service.contract import learning as schema
from service.contract.jobs import Job
from service.contract.observations import MOST_SEQUENCE, LearningOptions, StreamId
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

Sequence = Annotated[int, Path(ge=0, le=MOST_SEQUENCE)]
EXAMPLE = {"forgetting_s": 3600.0, "on_change": "hold", "contact_threshold": 8.0}
BATCH = "/{model}/observations/{stream_id}/{sequence}"

router = APIRouter(
    prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError, NotFoundError), route_class=Route
)


overview_router = APIRouter(
    prefix="/v1/overview", tags=["learning"], responses=responses(InvalidRequestError), route_class=Route
)


@overview_router.get("", summary="Models at a glance, newest first")
@needs(READ)
def show_overview(learners: LearnersDep, page: PageQuery) -> OverviewPage:
    """One page of models, each with all that a card of it shows: the learnt arm and its posture, error and coverage on
    what was held out and on what came in the last hour, what it carries, and its newest alarm. Loads no model."""
    return overview.list_models(learners, page)


@router.get("/{model}/quality", summary="How well a model predicts what it has not learnt yet")
@needs(READ)
def show_quality(learners: LearnersDep, model: str) -> schema.Quality:
    """Figures over sliding windows: every row is predicted, compared with what was measured, and learnt only then."""
    return status.read_quality(learners, model)


@router.get("/{model}/observations", summary="List observation batches, newest first")
@needs(READ)
def list_observations(
    learners: LearnersDep,
    model: str,
    page: PageQuery,
    stream_id: Annotated[StreamId | None, Query(description="Only batches of this stream")] = None,
    rejected: Annotated[bool, Query(description="Only batches with rows that were kept out")] = False,
) -> schema.ObservationPage:
    """One page of the log: which batches came and what became of their rows."""
    return status.list_batches(learners, model, page, stream_id, rejected)


@router.get(BATCH, summary="One observation batch")
@needs(READ)
def show_observation(
    learners: LearnersDep,
    model: str,
    stream_id: StreamId,
    sequence: Sequence,
    rows: Annotated[bool, Query(description="Also answer its rows, each with its code")] = False,
) -> schema.ObservationDetail:
    """What was said of a batch when it came, how well it was predicted, and what has become of it."""
    return status.read_batch(learners, model, stream_id, sequence, rows)


@router.delete(BATCH, summary="Unlearn an observation batch", responses=responses(ConflictError))
@needs(UPDATE)
def unlearn(learners: LearnersDep, model: str, stream_id: StreamId, sequence: Sequence) -> schema.Unlearnt:
    """Take the rows that a batch has taught, and replayed ones, out of what is learnt, exactly. It stays in the log.

    Where accelerations are derived, rows at a batch's edge are learnt with the batch beside it, and stay with that.
    """
    return decisions.unlearn(learners, model, stream_id, sequence)


@router.post(
    f"{BATCH}/replay", summary="Learn rejected rows of a batch", responses=responses(ConflictError, TooLargeError)
)
@needs(UPDATE)
def replay(
    learners: LearnersDep, model: str, stream_id: StreamId, sequence: Sequence, request: schema.ReplayRequest
) -> schema.Replayed:
    """Learn rows after all that were kept out, each once. Rows with the code `time_jump` count as of their arrival."""
    return decisions.replay(learners, model, stream_id, sequence, request)


@router.post(
    "/{model}/rollback",
    summary="Go back to a revision or a version",
    responses=responses(ConflictError, TooLargeError, UnreadableVersionError),
)
@needs(ADMIN)
def rollback(learners: LearnersDep, model: str, request: schema.RollbackRequest) -> schema.RolledBack:
    """Forget what was learnt since a revision of the version that serves, or let another version serve.

    What was unlearnt since stays unlearnt.
    """
    return decisions.rollback(learners, model, request)


@router.get("/{model}/learning", summary="How a model learns")
@needs(READ)
def show_learning(learners: LearnersDep, model: str) -> schema.Learning:
    """What is set, how far learning is, what it waits for, and where it can go back to."""
    return status.read_learning(learners, model)


@router.put(
    "/{model}/learning",
    summary="Set how a model learns",
    responses=responses(TooLargeError),
    openapi_extra={"requestBody": {"content": {"application/json": {"example": EXAMPLE}}}},
)
@needs(ADMIN)
def set_learning(learners: LearnersDep, model: str, options: LearningOptions) -> schema.Learning:
    """Set all options, those left out to their defaults. What has been learnt stays."""
    decisions.set_options(learners, model, options)
    return status.read_learning(learners, model)


@router.post(
    "/{model}/learning/change",
    summary="Decide about a change of the robot",
    responses=responses(ConflictError, TooLargeError),
)
@needs(ADMIN)
def decide(learners: LearnersDep, model: str, request: schema.ChangeRequest) -> schema.Decided:
    """End the hold that a detected change has led to: adapt to the changed robot, or go on as if nothing had been."""
    return decisions.decide(learners, model, request)


@router.get("/{model}/payload", summary="What the arm carries")
@needs(READ)
def show_payload(learners: LearnersDep, model: str) -> Payloads:
    """Mass, centre of mass and inertia of what each stream's robot carries, with what is not known of them.

    A payload is noticed, estimated and answered with by itself, from the rows that streams bring. No safety function.
    """
    return payload.read_payloads(learners, model)


@router.put(
    "/{model}/payload",
    summary="Declare what the arm carries",
    responses=responses(ConflictError, TooLargeError),
    openapi_extra={"requestBody": {"content": {"application/json": {"example": PAYLOAD_EXAMPLE}}}},
)
@needs(UPDATE)
def declare_payload(learners: LearnersDep, model: str, request: PayloadRequest) -> Payloads:
    """Answer with a payload from now on, as robot controllers are told theirs. Rows that say otherwise overrule it."""
    return payload.declare(learners, model, request)


@router.delete("/{model}/payload", summary="Say that the arm carries nothing", responses=responses(ConflictError))
@needs(UPDATE)
def remove_payload(
    learners: LearnersDep,
    model: str,
    stream_id: Annotated[
        StreamId | None, Query(description="The robot that has put it down; all where left out")
    ] = None,
) -> Payloads:
    """Answer without any payload from now on."""
    return payload.remove(learners, model, stream_id)


@router.delete(
    "/{model}/streams/{stream_id}", status_code=204, summary="Delete a stream", responses=responses(ConflictError)
)
@needs(UPDATE)
def delete_stream(learners: LearnersDep, model: str, stream_id: StreamId) -> None:
    """Forget a stream: its payload, its clock, and how wide its intervals are. What it has taught stays learnt, and its
    batches stay in the log. `GET …/learning` lists the streams."""
    decisions.delete_stream(learners, model, stream_id)


@router.get("/{model}/alarms", summary="List alarms, newest first")
@needs(READ)
def list_alarms(learners: LearnersDep, model: str, page: PageQuery) -> schema.AlarmPage:
    """One page of what the model's owner should know: changes, motion beyond what is known, new versions."""
    return decisions.alarms(learners, model, page)


@router.post(
    "/{model}/refresh",
    status_code=202,
    summary="Train the version that serves anew",
    responses=responses(NotFoundError, ConflictError, TooLargeError, BusyError),
)
@needs(TRAIN)
def create(queue: JobQueueDep, model: str, request: schema.RefreshRequest, response: Response) -> Job:
    """Queue a job that trains on the version's data sets and on what has been observed since.

    The new version serves if it predicts the newest third of the observations better than the serving version, before
    either has learnt them.
    """
    job = jobs.refresh(queue, model)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
