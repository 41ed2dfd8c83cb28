"""Making, finding and cancelling jobs."""

from __future__ import annotations

import math
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.fitting.estimators import UnknownEstimatorError, check_estimator
from lipcore.fitting.options import FitOptions
from lipcore.robots.library import ROBOTS, SimulationUnavailableError
from service.datasets import store
from service.foundation.errors import BusyError, ConflictError, InvalidRequestError, invalid_request, not_found, problem
from service.foundation.settings import Settings
from service.foundation.states import ACTIVE, CANCELLED, QUEUED, RUNNING
from service.models.loaded import LoadedModels
from service.robots import store as robots
from service.storage.database import Database, DatasetRow, JobRow, RobotRow, now
from service.storage.files import new_id
from service.training import holding_out, lifecycle
from service.training.queue import JobQueue
from service.training.schema import Job, JobPage, JobRequest, Options
from service.web.observability.logs import request_id
from service.web.rows import Identity, Page, done, mark, newest

USUAL_WAIT_S, LONGEST_WAIT_S = 30, 3600
"""Seconds after which who finds the queue full may try again: where nothing is known of the jobs that run, and most."""


def create(queue: JobQueue, request: JobRequest, retry_of: str | None = None, named: Identity | None = None) -> Job:
    """Check a request, store it as a queued job and hand it to the queue.

    retry_of: the job that it repeats; named: the request, which is not done again where it was before.
    """
    if (before := done_before(queue.database, named)) is not None:
        return before
    _check_options(request.options, queue.settings)
    if len(request.datasets) > queue.settings.max_job_datasets:
        raise invalid_request("datasets", len(request.datasets), f"at most {queue.settings.max_job_datasets}")
    rows = [store.find(queue.database, dataset) for dataset in request.datasets]
    joint_types = _check_joints(request, rows)
    if request.holdout is not None:
        holding_out.check(rows, request.holdout, queue.settings.min_samples)
    queue.storage.disk.require()  # for the version that will be made
    _check_estimator(queue.database, request, rows[0].joint_names, joint_types)
    with queue.database.transaction() as session:
        if (row := done(session, JobRow, named)) is not None:  # the same request was faster on another connection
            return shown(row)
        content = {**request.model_dump(mode="json"), "joint_types": joint_types}
        job = add(session, queue.settings, request.model, content, retry_of, named)
        present = set(session.scalars(select(DatasetRow.id).where(DatasetRow.id.in_(request.datasets))))
        for dataset in request.datasets:
            if dataset not in present:  # deleted since it was checked
                raise not_found("dataset", dataset)
        uploaded = request.robot is not None and request.robot not in ROBOTS
        if uploaded and session.scalar(select(RobotRow.id).where(RobotRow.id == request.robot)) is None:
            raise not_found("robot", request.robot)
    queue.submit(job.id)
    return shown(job)


def done_before(database: Database, named: Identity | None) -> Job | None:
    """The job that a request has made before, as it is now; None where it has not. Raise ConflictError."""
    with database.session() as session:
        row = done(session, JobRow, named)
    return None if row is None else shown(row)


def add(
    session: Session,
    settings: Settings,
    model: str,
    request: dict[str, Any],
    retry_of: str | None = None,
    named: Identity | None = None,
) -> JobRow:
    """Add a queued job, to be handed to the queue once the session has committed; raise BusyError for a full queue."""
    waiting = session.scalar(select(func.count()).select_from(JobRow).where(JobRow.state == QUEUED)) or 0
    if waiting >= settings.max_queued_jobs:
        raise BusyError(
            f"{waiting} jobs are waiting already, the most that may: try again later",
            headers={"Retry-After": str(_seconds_to_wait(session))},
        )
    job = JobRow(
        id=new_id("job"),
        model=model,
        request=request,
        progress={},
        attempts=0,
        cancel_requested=False,
        created_at=now(),
        history=[],
        retry_of=retry_of,
        request_id=request_id.get(),
    )
    mark(job, named)
    lifecycle.enter(job, QUEUED, "queued" if retry_of is None else f"queued to repeat {retry_of}")
    session.add(job)
    return job


def _seconds_to_wait(session: Session) -> int:
    """When the first of the jobs that run may end and another one leave the queue, s: a guess where none can tell."""
    left = [row.get("remaining_s") for row in session.scalars(select(JobRow.progress).where(JobRow.state == RUNNING))]
    known = [seconds for seconds in left if seconds is not None]
    return math.ceil(min(max(min(known), 1.0), LONGEST_WAIT_S)) if known else USUAL_WAIT_S


def show(queue: JobQueue, loaded: LoadedModels, job: str) -> Job:
    """Return one job; raise NotFoundError. Who sees it succeed is answered by its version from then on."""
    row = find(queue.database, job)
    if row.version is not None:
        loaded.announce([row.model])
    return shown(row)


def page(queue: JobQueue, loaded: LoadedModels, part: Page) -> JobPage:
    """List jobs, newest first. Who sees one succeed is answered by its version from then on."""
    with queue.database.session() as session:
        rows, following = newest(session, JobRow, part)
    loaded.announce({row.model for row in rows if row.version is not None})
    return JobPage(items=[shown(row) for row in rows], next_cursor=following)


def find(database: Database, job: str) -> JobRow:
    """Return a job's row; raise NotFoundError."""
    with database.session() as session:
        row = session.scalar(select(JobRow).where(JobRow.id == job))
    if row is None:
        raise not_found("job", job)
    return row


def cancel(queue: JobQueue, job: str) -> Job:
    """Cancel a job: at once while it waits; while it runs within `job_cancel_grace_s`, with or without its consent.

    Raise NotFoundError, ConflictError where it has ended.
    """
    queue.stop(job)  # before anything is written, for which its process may hold the lock
    with queue.database.transaction() as session:
        row = session.scalar(select(JobRow).where(JobRow.id == job))
        if row is None:
            raise not_found("job", job)
        if row.state not in ACTIVE:
            raise ConflictError(f"{job} has {row.state} already")
        if row.state == QUEUED:
            lifecycle.enter(row, CANCELLED, "cancelled while it waited")
        elif not row.cancel_requested:
            lifecycle.enter(row, RUNNING, "asked to end")
        row.cancel_requested = True
    return shown(row)


def _check_joints(request: JobRequest, rows: list[DatasetRow]) -> list[str]:
    first = rows[0]
    for index, row in enumerate(rows):
        if row.id in request.datasets[:index]:
            raise invalid_request(f"datasets[{index}]", row.id, "every data set once")
        for what in ("joint_names", "torque_convention"):
            if getattr(row, what) != getattr(first, what):
                expected = f"the {what} of datasets[0], {getattr(first, what)}"
                raise invalid_request(f"datasets[{index}]", f"a data set with {getattr(row, what)}", expected)
    n = len(first.joint_names)
    known = next((each for row in rows if (each := row.report.get("joint_types")) is not None), ["revolute"] * n)
    types: list[str] = list(known if request.joint_types is None else request.joint_types)
    if len(types) != n:
        raise invalid_request("joint_types", f"{len(types)} types", f"{n}, one a joint: {', '.join(first.joint_names)}")
    return types


def _check_estimator(database: Database, request: JobRequest, joint_names: list[str], joint_types: list[str]) -> None:
    """Check what the training process will, so that what it refuses is refused here."""
    try:
        robot = None
        if request.robot is not None:
            robot = robots.resolve(database, request.robot, joint_names, joint_types)
        check_estimator(request.estimator, joint_types, robot, FitOptions(**request.options.model_dump()))
    except UnknownEstimatorError as error:
        expected = str(error).partition("expected ")[2]
        raise invalid_request("estimator", request.estimator, expected) from None
    except (ValueError, SimulationUnavailableError) as error:
        detail = problem("robot", request.robot, "a profile or the id of an uploaded URDF, with the joints of the data")
        raise InvalidRequestError(str(error), [detail]) from None


def _check_options(options: Options, settings: Settings) -> None:
    for name in ("hyperparameter_samples", "posterior_samples", "max_inducing_outputs"):
        most = getattr(settings, name if name.startswith("max_") else f"max_{name}")
        if getattr(options, name) > most:
            raise invalid_request(f"options.{name}", getattr(options, name), f"at most {most}")


def shown(row: JobRow) -> Job:
    """A job as the API shows it: columns of its row, and what its request says."""
    fields = {name: getattr(row, name, row.request.get(name)) for name in Job.model_fields}
    return Job.model_validate(fields)
