"""A job's changes as server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

from anyio import to_thread
from fastapi import Depends
from fastapi.sse import ServerSentEvent

from service.foundation.states import ACTIVE
from service.models.loaded import LoadedModels
from service.storage.database import JobRow
from service.training import jobs
from service.training.queue import JobQueue, JobQueueDep


def _row(queue: JobQueueDep, job: str) -> JobRow:
    return jobs.find(queue.database, job)


async def _followed(queue: JobQueueDep, row: Annotated[JobRow, Depends(_row)]) -> AsyncIterator[JobRow]:
    """The job at the start; one more is counted while the answer lasts."""
    with queue.feed.one_more(queue.settings.max_job_followers):
        yield row


FollowedDep = Annotated[JobRow, Depends(_followed)]


async def events(
    queue: JobQueue, loaded: LoadedModels, closing: asyncio.Event, row: JobRow
) -> AsyncIterator[ServerSentEvent]:
    """`state` with the job as it is; then `state` or `progress`, each with the whole job; ends with the job."""
    last: JobRow | None = None
    async for now in queue.feed.follow(row, closing):
        kind = None if last is None else _kind(last, now)
        if last is not None and kind is None:
            continue
        if now.version is not None:  # who sees it succeed is answered by its version from then on
            await to_thread.run_sync(loaded.announce, [now.model])
        yield ServerSentEvent(event=kind or "state", data=jobs.shown(now))
        if now.state not in ACTIVE:
            return
        last = now


def _kind(before: JobRow, now: JobRow) -> str | None:
    """What has changed, None where nothing has that a reader would care for."""
    if (before.state, before.history) != (now.state, now.history):
        return "state"
    return "progress" if before.progress != now.progress else None
