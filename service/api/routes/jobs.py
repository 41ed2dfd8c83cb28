"""A job's changes as server-sent events."""

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
from service.training import jobs
from service.training.feed import MAX_FOLLOWERS
from service.training.queue import JobQueue


def _row(queue: JobQueueDep, job: str) -> JobRow:
    return jobs.find(queue.database, job)


async def _followed(queue: JobQueueDep, row: Annotated[JobRow, Depends(_row)]) -> AsyncIterator[JobRow]:
    """The job at the start; one more is counted while the answer lasts."""
    with queue.feed.count_one(MAX_FOLLOWERS):
        yield row


FollowedDep = Annotated[JobRow, Depends(_followed)]


async def _events(
    queue: JobQueue, loaded: LoadedModels, closing: asyncio.Event, row: JobRow
) -> AsyncIterator[ServerSentEvent]:
    """`state` with the job as it is; then `state` or `progress`, each with the whole job; ends with the job."""
    last: JobRow | None = None
    async for now in queue.feed.follow(row, closing):
        kind = None if last is None else _kind(last, now)
        if last is not None and kind is None:
            continue
        job = jobs.represent(now)
        if now.version is not None:  # who sees it succeed is answered by its version from then on
            await to_thread.run_sync(loaded.announce, [now.model])
            [job] = await to_thread.run_sync(jobs.represent_all, queue.database, [now])
        yield ServerSentEvent(event=kind or "state", data=job)
        if now.state not in ACTIVE:
            return
        last = now


def _kind(before: JobRow, now: JobRow) -> str | None:
    """What has changed, None where nothing has that a reader would care for."""
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
    """Queue a training job. It runs in another process and ends in a new version of the model."""
    named = identify_request(idempotency_key, "train", request.model_dump(mode="json", exclude_unset=True))
    job = jobs.create(queue, request, named=named)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.post(
    "/check",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Check a job before its data are uploaded",
    responses=responses(NotFoundError, ConflictError),
)
@needs(TRAIN)
def check(queue: JobQueueDep, draft: JobDraft) -> None:
    """Refuse what a request to train would be refused for, as far as the data sets that are there tell. Nothing is
    queued."""
    jobs.check(queue, draft)


@router.get("", summary="List jobs, newest first")
@needs(READ)
def list_jobs(queue: JobQueueDep, loaded: LoadedModelsDep, page: PageQuery) -> JobPage:
    """One page of jobs with their progress."""
    return jobs.page(queue, loaded, page)


@router.get("/{job}", summary="One job and its progress", responses=responses(NotFoundError))
@needs(READ)
def show(queue: JobQueueDep, loaded: LoadedModelsDep, job: str) -> Job:
    """State, progress, and the version it made or why it failed."""
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
    """Server-sent events, each with the whole job as its data: `state` at the start, at every entry of its history and
    at its end; `progress` in between, about twice a second. The answer ends with the job, or when the service stops:
    ask again then, the first event says how it stands."""
    async for event in _events(queue, loaded, stopping.closing, row):
        yield event


@router.post("/{job}/cancel", summary="Cancel a job", responses=responses(NotFoundError, ConflictError))
@needs(TRAIN)
def cancel(queue: JobQueueDep, job: str) -> Job:
    """Cancel a waiting job at once, a running one within two seconds: a process that does not obey is killed."""
    return jobs.cancel(queue, job)


@router.post(
    "/{job}/retry",
    status_code=status.HTTP_202_ACCEPTED,
    summary="Repeat a job that failed or was cancelled",
    responses=responses(NotFoundError, ConflictError, BusyError),
)
@needs(TRAIN)
def retry(queue: JobQueueDep, job: str, response: Response, idempotency_key: KeyHeader = None) -> Job:
    """Queue a new job with the same request; `retry_of` names the old one. What it needs must still be there."""
    again = jobs.retry(queue, job, identify_request(idempotency_key, "retry", job))
    response.headers["Location"] = f"/v1/jobs/{again.id}"
    return again
