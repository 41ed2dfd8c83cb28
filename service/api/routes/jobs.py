"""Routes of training jobs, and their progress as server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Depends, Response, status
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.api.access.scopes import READ, TRAIN, needs
from service.api.dependencies import JobQueueDep, KeyHeader, LoadedModelsDep, PageQuery, StoppingDep
from service.api.errors import responses
from service.api.route import Route
from service.contract.jobs import Job, JobDraft, JobPage, JobRequest
from service.contract.states import ACTIVE
from service.foundation.errors import (
    BusyError,
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    NotInstalledError,
    TooLargeError,
)
from service.models.loaded import LoadedModels
from service.storage.database import JobRow
from service.storage.rows import identify_request
from service.training import jobs, requests
from service.training.feed import MAX_FOLLOWERS
from service.training.queue import JobQueue


def _row(queue: JobQueueDep, job: str) -> JobRow:
    return jobs.find(queue.database, job)


async def _followed(queue: JobQueueDep, row: Annotated[JobRow, Depends(_row)]) -> AsyncIterator[JobRow]:
    """Yield the job as it is at the start, and count one follower until the answer ends."""
    with queue.feed.count_one(MAX_FOLLOWERS):
        yield row


FollowedDep = Annotated[JobRow, Depends(_followed)]


async def _events(
    queue: JobQueue, loaded: LoadedModels, closing: asyncio.Event, row: JobRow
) -> AsyncIterator[ServerSentEvent]:
    """Yield a `state` event, then a `state` or `progress` event at every change, until the job ends."""
    last: JobRow | None = None
    async for now in queue.feed.follow(row, closing):
        kind = None if last is None else _kind(last, now)
        if last is not None and kind is None:
            continue
        job = jobs.represent(now)
        if now.version is not None:  # a client that sees the job succeed must get answers from its version
            await to_thread.run_sync(loaded.announce, [now.model])
            [job] = await to_thread.run_sync(jobs.represent_all, queue.database, [now])
        yield ServerSentEvent(event=kind or "state", data=job)
        if now.state not in ACTIVE:
            return
        last = now


def _kind(before: JobRow, now: JobRow) -> str | None:
    """Return the kind of event for a change, None if no visible field changed."""
    if (before.state, before.history) != (now.state, now.history):
        return "state"
    return "progress" if before.progress != now.progress else None


router = APIRouter(
    prefix="/v1/jobs", tags=["training jobs"], responses=responses(InvalidRequestError), route_class=Route
)


@router.post(
    "",
    status_code=status.HTTP_202_ACCEPTED,
    summary="Train a model",
    responses=responses(NotFoundError, TooLargeError, BusyError, ConflictError, NotInstalledError),
)
@needs(TRAIN)
def create(queue: JobQueueDep, request: JobRequest, response: Response, idempotency_key: KeyHeader = None) -> Job:
    """Queue a training job. It runs in a separate process and creates a new version of the model.

    Poll `GET /v1/jobs/{job}` or follow `GET /v1/jobs/{job}/events` to see its progress.
    """
    named = identify_request(idempotency_key, "train", request.model_dump(mode="json", exclude_unset=True))
    job = jobs.create(queue, request, named=named)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.post(
    "/check",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Check a training request before uploading data",
    responses=responses(NotFoundError, ConflictError),
)
@needs(TRAIN)
def check(queue: JobQueueDep, draft: JobDraft) -> None:
    """Run the checks of `POST /v1/jobs` without queueing a job.

    Data sets that are not uploaded yet cannot be checked. The errors are those of `POST /v1/jobs`.
    """
    requests.check_draft(queue, draft)


@router.get("", summary="List jobs, newest first")
@needs(READ)
def list_jobs(queue: JobQueueDep, loaded: LoadedModelsDep, page: PageQuery) -> JobPage:
    """Return one page of jobs with their progress."""
    return jobs.page(queue, loaded, page)


@router.get("/{job}", summary="Retrieve a job and its progress", responses=responses(NotFoundError))
@needs(READ)
def show(queue: JobQueueDep, loaded: LoadedModelsDep, job: str) -> Job:
    """Return a job's state and progress, and the version that it created or the reason why it failed."""
    return jobs.show(queue, loaded, job)


@router.get(
    "/{job}/events",
    summary="Follow a job",
    response_class=EventSourceResponse,
    responses=responses(NotFoundError, BusyError),
)
@needs(READ, lasting=True)
async def follow(
    queue: JobQueueDep, loaded: LoadedModelsDep, stopping: StoppingDep, row: FollowedDep
) -> AsyncIterable[ServerSentEvent]:
    """Stream the progress of a job as server-sent events. The data of every event is the whole job.

    - `state` is sent at the start, at every new entry of the job's history, and at its end.
    - `progress` is sent in between, about twice a second.

    The stream ends with the job or when the service stops. Reconnect then: the first event has the current state.
    """
    async for event in _events(queue, loaded, stopping.closing, row):
        yield event


@router.post("/{job}/cancel", summary="Cancel a job", responses=responses(NotFoundError, ConflictError))
@needs(TRAIN)
def cancel(queue: JobQueueDep, job: str) -> Job:
    """Cancel a job: at once if it is queued, within two seconds if it runs.

    A process that does not stop in time is killed.
    """
    return jobs.cancel(queue, job)


@router.post(
    "/{job}/retry",
    status_code=status.HTTP_202_ACCEPTED,
    summary="Retry a failed or cancelled job",
    responses=responses(NotFoundError, ConflictError, BusyError),
)
@needs(TRAIN)
def retry(queue: JobQueueDep, job: str, response: Response, idempotency_key: KeyHeader = None) -> Job:
    """Queue a new job with the same request. Its `retry_of` names the old job.

    The data sets, robots and models of the request must still exist.
    """
    again = jobs.retry(queue, job, identify_request(idempotency_key, "retry", job))
    response.headers["Location"] = f"/v1/jobs/{again.id}"
    return again
