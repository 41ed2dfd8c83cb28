"""Routes of training jobs."""

from __future__ import annotations

from fastapi import APIRouter, Response, status

from service.context import ServiceDep
from service.errors import BusyError, ConflictError, InvalidRequestError, NotFoundError, TooLargeError, responses
from service.pages import PageQuery
from service.training import jobs
from service.training.schema import Job, JobPage, JobRequest

router = APIRouter(prefix="/v1/jobs", tags=["training jobs"], responses=responses(InvalidRequestError))


@router.post(
    "",
    status_code=status.HTTP_202_ACCEPTED,
    summary="Train a model",
    responses=responses(NotFoundError, TooLargeError, BusyError),
)
def create(service: ServiceDep, request: JobRequest, response: Response) -> Job:
    """Queue a training job. It runs in another process and ends in a new version of the model."""
    job = jobs.create(service, request)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.get("", summary="List jobs, newest first")
def list_jobs(service: ServiceDep, page: PageQuery) -> JobPage:
    """One page of jobs with their progress."""
    return jobs.page(service, page)


@router.get("/{job}", summary="One job and its progress", responses=responses(NotFoundError))
def show(service: ServiceDep, job: str) -> Job:
    """State, progress, and the version it made or why it failed."""
    return jobs.show(service, job)


@router.post("/{job}/cancel", summary="Cancel a job", responses=responses(NotFoundError, ConflictError))
def cancel(service: ServiceDep, job: str) -> Job:
    """Cancel a waiting job at once, a running one within about a second."""
    return jobs.cancel(service.database, job)
