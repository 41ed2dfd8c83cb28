"""Routes of what the owner of a learning model sees and decides."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query

from service.foundation.errors import (
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnreadableVersionError,
    responses,
)
from service.learning.control import decisions, inspection, replaying, status, undoing
from service.learning.control.learning_schema import AlarmPage, ChangeRequest, Decided, Learning
from service.learning.control.schema import (
    ObservationDetail,
    ObservationPage,
    Quality,
    Replayed,
    ReplayRequest,
    RollbackRequest,
    RolledBack,
    Unlearnt,
)
from service.learning.learning_options import LearningOptions
from service.learning.quality import summary
from service.learning.schema import MOST_SEQUENCE, StreamId
from service.learning.updates import UpdatesDep
from service.web.pagination import PageQuery
from service.web.route import Route

Sequence = Annotated[int, Path(ge=0, le=MOST_SEQUENCE)]
EXAMPLE = {"forgetting_s": 3600.0, "on_change": "hold", "contact_threshold": 8.0}
BATCH = "/{model}/observations/{stream_id}/{sequence}"

router = APIRouter(
    prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError, NotFoundError), route_class=Route
)


@router.get("/{model}/quality", summary="How well a model predicts what it has not learnt yet")
def show_quality(updates: UpdatesDep, model: str) -> Quality:
    """Figures over sliding windows: every row is predicted, compared with what was measured, and learnt only then."""
    return summary.show(updates, model)


@router.get("/{model}/observations", summary="List observation batches, newest first")
def list_observations(
    updates: UpdatesDep,
    model: str,
    page: PageQuery,
    stream_id: Annotated[StreamId | None, Query(description="Only batches of this stream")] = None,
    rejected: Annotated[bool, Query(description="Only batches with rows that were kept out")] = False,
) -> ObservationPage:
    """One page of the log: which batches came and what became of their rows."""
    return inspection.page(updates, model, page, stream_id, rejected)


@router.get(BATCH, summary="One observation batch")
def show_observation(
    updates: UpdatesDep,
    model: str,
    stream_id: StreamId,
    sequence: Sequence,
    rows: Annotated[bool, Query(description="Also answer its rows, each with its code")] = False,
) -> ObservationDetail:
    """What was said of a batch when it came, how well it was predicted, and what has become of it."""
    return inspection.show(updates, model, stream_id, sequence, rows)


@router.delete(BATCH, summary="Unlearn an observation batch", responses=responses(ConflictError))
def unlearn(updates: UpdatesDep, model: str, stream_id: StreamId, sequence: Sequence) -> Unlearnt:
    """Take the rows that a batch has taught, and replayed ones, out of what is learnt, exactly. It stays in the log.

    Where accelerations are derived, rows at a batch's edge are learnt with the batch beside it, and stay with that.
    """
    return undoing.unlearn(updates, model, stream_id, sequence)


@router.post(
    f"{BATCH}/replay", summary="Learn rejected rows of a batch", responses=responses(ConflictError, TooLargeError)
)
def replay(
    updates: UpdatesDep, model: str, stream_id: StreamId, sequence: Sequence, request: ReplayRequest
) -> Replayed:
    """Learn rows after all that were kept out, each once. Rows with the code `time_jump` count as of their arrival."""
    return replaying.replay(updates, model, stream_id, sequence, request)


@router.post(
    "/{model}/rollback",
    summary="Go back to a revision or a version",
    responses=responses(ConflictError, TooLargeError, UnreadableVersionError),
)
def rollback(updates: UpdatesDep, model: str, request: RollbackRequest) -> RolledBack:
    """Forget what was learnt since a revision of the version that serves, or let another version serve.

    What was unlearnt since stays unlearnt.
    """
    return undoing.rollback(updates, model, request)


@router.get("/{model}/learning", summary="How a model learns")
def show_learning(updates: UpdatesDep, model: str) -> Learning:
    """What is set, how far learning is, what it waits for, and where it can go back to."""
    return status.show(updates, model)


@router.put(
    "/{model}/learning",
    summary="Set how a model learns",
    responses=responses(TooLargeError),
    openapi_extra={"requestBody": {"content": {"application/json": {"example": EXAMPLE}}}},
)
def set_learning(updates: UpdatesDep, model: str, options: LearningOptions) -> Learning:
    """Set all options, those left out to their defaults. What has been learnt stays."""
    decisions.set_options(updates, model, options)
    return status.show(updates, model)


@router.post(
    "/{model}/learning/change",
    summary="Decide about a change of the robot",
    responses=responses(ConflictError, TooLargeError),
)
def decide(updates: UpdatesDep, model: str, request: ChangeRequest) -> Decided:
    """End the hold that a detected change has led to: adapt to the changed robot, or go on as if nothing had been."""
    return decisions.decide(updates, model, request)


@router.get("/{model}/alarms", summary="List alarms, newest first")
def list_alarms(updates: UpdatesDep, model: str, page: PageQuery) -> AlarmPage:
    """One page of what the model's owner should know: changes, motion beyond what is known, new versions."""
    return decisions.page(updates, model, page)
