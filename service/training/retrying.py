"""Doing an ended job again: a new job with the same request."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.foundation.errors import ConflictError, NotFoundError
from service.foundation.states import CANCELLED, FAILED
from service.training import jobs, refreshes
from service.training.schema import Job, JobRequest
from service.web.idempotency import Identity

if TYPE_CHECKING:
    from service.training.queue import JobQueue


def retry(queue: JobQueue, job: str, named: Identity | None = None) -> Job:
    """Queue a job that repeats one that failed or was cancelled; a refresh starts from what serves and is known now.

    named: the request, which is not done again where it was before.
    Raise NotFoundError, ConflictError where the job has not failed or what it needs is no longer there,
    InvalidRequestError where a limit has become lower since, BusyError for a full queue.
    """
    row = jobs.find(queue.database, job)
    if (before := jobs.done_before(queue.database, named)) is not None:
        return before
    if row.state not in (FAILED, CANCELLED):
        raise ConflictError(f"job {job!r} is {row.state}: only one that has failed or was cancelled can be repeated")
    try:
        again = row.request.get("refresh")
        if again is not None:
            return refreshes.ask(queue, row.model, again["trigger"], row.id, named)
        request = JobRequest.model_validate(
            {name: row.request[name] for name in JobRequest.model_fields if name in row.request}  # older ones lack some
        )
        return jobs.create(queue, request, retry_of=row.id, named=named)
    except NotFoundError as error:
        raise ConflictError(f"job {job!r} cannot be repeated: {error.message}") from None
