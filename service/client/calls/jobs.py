"""Calls about training jobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from service.client.call import Call, Page, Route, given, page, record, route
from service.client.calls.keys import KEY_HEADER, new_key
from service.training.schema import Job


@route("POST", "/v1/jobs", repeatable=True)
def train(
    at: Route,
    model: str,
    datasets: Sequence[str],
    estimator: str | None = None,
    joint_types: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    robot: str | None = None,
    holdout: Mapping[str, Any] | None = None,
    *,
    idempotency_key: str | None = None,
) -> Call[Job]:
    """Queue a training job.

    robot: for rigid bodies, a profile such as panda or the id of an uploaded URDF; holdout: what to hold out of the
    data sets and evaluate the version on, such as {"kind": "last", "share": 0.3}; idempotency_key: the same request
    under the same key queues one job, also from another client.
    """
    body: dict[str, Any] = {"model": model, "datasets": list(datasets), "options": dict(options or {})}
    body |= given(
        estimator=estimator,
        joint_types=None if joint_types is None else list(joint_types),
        robot=robot,
        holdout=None if holdout is None else dict(holdout),
    )
    return at(record(Job), names={}, json=body, headers={KEY_HEADER: idempotency_key or new_key()})


@route("GET", "/v1/jobs")
def jobs(at: Route) -> Call[Page[Job]]:
    """All jobs, newest first."""
    return at(page(Job), names={})


@route("GET", "/v1/jobs/{job}")
def job(at: Route, job: str) -> Call[Job]:
    """A job with its progress."""
    return at(record(Job), names={"job": job})


@route("GET", "/v1/jobs/{job}/events")
def job_events(at: Route, job: str) -> Call[Job]:
    """A job as it is and at every change, until it ends or the service stops."""
    return at(record(Job), names={"job": job})


@route("POST", "/v1/jobs/{job}/cancel")
def cancel(at: Route, job: str) -> Call[Job]:
    """Cancel a job."""
    return at(record(Job), names={"job": job})


@route("POST", "/v1/jobs/{job}/retry", repeatable=True)
def retry(at: Route, job: str, *, idempotency_key: str | None = None) -> Call[Job]:
    """Queue a new job that repeats one that failed or was cancelled."""
    return at(record(Job), names={"job": job}, headers={KEY_HEADER: idempotency_key or new_key()})
