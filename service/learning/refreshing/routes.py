"""Route of refreshes."""

from __future__ import annotations

from fastapi import APIRouter, Response, status
from pydantic import BaseModel, ConfigDict

from service.foundation.errors import (
    BusyError,
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    responses,
)
from service.training import refreshes
from service.training.queue import JobQueueDep
from service.training.schema import Job
from service.web.route import Route

router = APIRouter(prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError), route_class=Route)


class RefreshRequest(BaseModel):
    """Nothing to choose: estimator, options and robot are those of the version that serves."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"examples": [{}]})


@router.post(
    "/{model}/refresh",
    status_code=status.HTTP_202_ACCEPTED,
    summary="Train the version that serves anew",
    responses=responses(NotFoundError, ConflictError, TooLargeError, BusyError),
)
def create(queue: JobQueueDep, model: str, request: RefreshRequest, response: Response) -> Job:
    """Queue a job that trains on the version's data sets and on what has been observed since.

    The version that it makes learns along and answers once it has predicted better than the one that serves.
    """
    job = refreshes.ask(queue, model)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
