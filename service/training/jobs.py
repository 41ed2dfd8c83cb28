"""Create, find, cancel and repeat training jobs and refreshes.

A refresh retrains the serving version on its data sets and on the observations since.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from lipcore.model.verdict import OPTIONS
from lipcore.robots.library import ROBOTS
from lipcore.vocabulary import TORCH_ESTIMATORS
from service.contract.jobs import Job, JobPage, JobRequest
from service.contract.states import ACTIVE, CANCELLED, FAILED, QUEUED, RUNNING
from service.datasets.mapping.checks import MIN_SAMPLES
from service.foundation.errors import (
    BusyError,
    ConflictError,
    NotFoundError,
    not_found,
)
from service.journal import log
from service.models import registry, verdicts
from service.models.loaded import LoadedModels
from service.storage.database import Database, DatasetRow, JobRow, RobotRow, VersionRow, now
from service.storage.files import new_id
from service.storage.rows import Page, RequestIdentity, find_done_row, mark_row, read_page
from service.telemetry.logs import KEY_ID, request_id, request_scope
from service.training import lifecycle, refresh_data, requests, texts
from service.training.queue import JobQueue

MAX_QUEUED = 100
"""Maximum waiting jobs; further requests are answered 429."""


def create(
    queue: JobQueue, request: JobRequest, retry_of: str | None = None, named: RequestIdentity | None = None
) -> Job:
    """Check a request, store it as a queued job and submit it to the queue.

    `retry_of` is the job that it repeats; `named` identifies the request, which runs only once.
    """
    if (before := done_before(queue.database, named)) is not None:
        return before
    rows, joint_types, base = requests.check(queue, request)
    request = requests.with_default_robot(queue.database, request, rows, joint_types)
    queue.storage.disk.require()  # room for the new version
    with queue.database.transaction() as session:
        if (
            row := find_done_row(session, JobRow, named)
        ) is not None:  # the same request arrived first on another connection
            return represent(row)
        ids = [row.id for row in rows]
        content = {**request.model_dump(mode="json"), "joint_types": joint_types, "datasets": ids}
        if base is not None:
            content["base"] = f"{base.model}:{base.version}"
            if not registry.exists(session, base.model, base.version):  # deleted since it was checked
                raise not_found("version", base.version)
        job = add(session, request.model, content, retry_of, named)
        present = set(session.scalars(select(DatasetRow.id).where(DatasetRow.id.in_(ids))))
        for dataset in ids:
            if dataset not in present:  # deleted since it was checked
                raise not_found("dataset", dataset)
        uploaded = request.robot is not None and request.robot not in ROBOTS
        if uploaded and session.scalar(select(RobotRow.id).where(RobotRow.id == request.robot)) is None:
            raise not_found("robot", request.robot)
    queue.submit(job.id)
    return represent(job)


def done_before(database: Database, named: RequestIdentity | None) -> Job | None:
    """Return the job that this request has made before, None if there is none; raise ConflictError."""
    with database.session() as session:
        row = find_done_row(session, JobRow, named)
    return None if row is None else represent(row)


def add(
    session: Session,
    model: str,
    request: dict[str, Any],
    retry_of: str | None = None,
    named: RequestIdentity | None = None,
) -> JobRow:
    """Add a queued job; raise BusyError if the queue is full. Submit it once the session has committed."""
    waiting = session.scalar(select(func.count()).select_from(JobRow).where(JobRow.state == QUEUED)) or 0
    if waiting >= MAX_QUEUED:
        raise BusyError(
            f"the queue is full, with {waiting} waiting jobs: retry later",
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
        key=(request_scope.get() or {}).get(KEY_ID),
    )
    mark_row(job, named)
    lifecycle.enter(job, QUEUED, texts.describe_queued(retry_of))
    session.add(job)
    return job


def _seconds_to_wait(session: Session) -> int:
    """Estimate when the first running job ends and a place in the queue becomes free, s; 30 s if unknown."""
    left = [row.get("remaining_s") for row in session.scalars(select(JobRow.progress).where(JobRow.state == RUNNING))]
    known = [seconds for seconds in left if seconds is not None]
    return math.ceil(min(max(min(known), 1.0), 3600)) if known else 30


def show(queue: JobQueue, loaded: LoadedModels, job: str) -> Job:
    """Return one job; raise NotFoundError. If it has succeeded, its version answers from then on."""
    row = find(queue.database, job)
    if row.version is not None:
        loaded.announce([row.model])
    return represent_all(queue.database, [row])[0]


def page(queue: JobQueue, loaded: LoadedModels, part: Page) -> JobPage:
    """List jobs, newest first. Versions of jobs listed as succeeded answer from then on."""
    with queue.database.session() as session:
        rows, following = read_page(session, JobRow, part)
    loaded.announce({row.model for row in rows if row.version is not None})
    return JobPage(items=represent_all(queue.database, rows), next_cursor=following)


def find(database: Database, job: str) -> JobRow:
    """Return a job's row; raise NotFoundError."""
    with database.session() as session:
        return _existing(lifecycle.row_of(session, job), job)


def _existing(row: JobRow | None, job: str) -> JobRow:
    if row is None:
        raise not_found("job", job)
    return row


def cancel(queue: JobQueue, job: str) -> Job:
    """Cancel a job: at once if it waits; within `JobLimits.cancel_s` if it runs.

    Raise NotFoundError, ConflictError if it has ended.
    """
    queue.stop(job)  # before the transaction, as the job's process may hold the lock
    with queue.database.transaction() as session:
        row = _existing(lifecycle.row_of(session, job), job)
        if row.state not in ACTIVE:
            raise ConflictError(f"{job} has already ended ({row.state})")
        if row.state == QUEUED:
            lifecycle.enter(row, CANCELLED, texts.CANCELLED_WAITING)
        elif not row.cancel_requested:
            lifecycle.enter(row, RUNNING, texts.CANCEL_REQUESTED)
        row.cancel_requested = True
    return represent(row)


def represent(row: JobRow) -> Job:
    """Return a job as the API shows it, from the columns of its row and its request."""
    fields = {name: getattr(row, name, row.request.get(name)) for name in Job.model_fields}
    return Job.model_validate(fields)


def represent_all(database: Database, rows: Sequence[JobRow]) -> list[Job]:
    """Return jobs as the API shows them, with the verdicts on the versions that they made."""
    made = {(row.model, row.version) for row in rows if row.version is not None}
    with database.session() as session:
        versions = registry.rows_of(session, made) if made else {}
    options = registry.verdict_options(database, {model for model, _ in made})
    jobs = []
    for row in rows:
        version = None if row.version is None else versions.get((row.model, row.version))
        known = options.get(row.model, OPTIONS)
        verdict = None if version is None else verdicts.of_version(version.manifest, known)
        jobs.append(represent(row).model_copy(update={"verdict": verdict}))
    return jobs


Trigger = Literal["novelty", "linearisation", "asked"]


def refresh(
    queue: JobQueue,
    model: str,
    trigger: Trigger = "asked",
    retry_of: str | None = None,
    named: RequestIdentity | None = None,
) -> Job:
    """Queue a refresh of the serving version and return its job. Blocking: use it in a thread.

    `retry_of` is the job that it repeats; `named` identifies the request if the client named it. Raise NotFoundError,
    BusyError if the queue is full, ConflictError if a refresh of the model is queued or runs, or if there are no data
    to train on.
    """
    version = registry.find(queue.database, model, None)
    with queue.database.transaction() as session:
        if (before := find_done_row(session, JobRow, named)) is not None:
            return represent(before)
        job = add_refresh(session, version, trigger, retry_of, named)
    queue.submit(job.id)
    return represent(job)


def add_refresh(
    session: Session,
    version: VersionRow,
    trigger: Trigger,
    retry_of: str | None = None,
    named: RequestIdentity | None = None,
) -> JobRow:
    """Add the job of a refresh; raise ConflictError or BusyError."""
    model, manifest = version.model, version.manifest
    if not registry.exists(session, model, version.version):  # deleted since it was found
        raise not_found("version", version.version)
    for job in session.scalars(refreshes_of(model).where(JobRow.state.in_(ACTIVE))):
        raise ConflictError(f"{job.id} already refreshes model {model!r}: wait until it ends, or cancel it")
    through = log.newest(session, model)
    scope = refresh_data.scope_of(session, model, through)
    kept, left_out = refresh_data.split_datasets(session, scope, manifest["lineage"])
    rows = refresh_data.rows_within(session, model, scope)
    if not kept and rows < MIN_SAMPLES:
        raise ConflictError(_nothing(version, rows, left_out, MIN_SAMPLES))
    made_by = None if version.job is None else session.scalar(select(JobRow).where(JobRow.id == version.job))
    options = manifest["options"]
    if manifest["estimator"] not in TORCH_ESTIMATORS:  # earlier releases trained every estimator on a GPU
        options = {**options, "device": "auto"}
    request = {
        "model": model,
        "datasets": [row.id for row in kept],
        "estimator": manifest["estimator"],
        "joint_types": manifest["joint_types"],
        "robot": made_by.request.get("robot") if made_by is not None and "robot" in manifest else None,
        "options": options,
        "refresh": {"version": version.version, "through": through, "trigger": trigger},
    }
    return add(session, model, request, retry_of, named)


def _nothing(version: VersionRow, rows: int, left_out: list[dict[str, str]], least: int) -> str:
    data = "; ".join(f"data set {each['id']!r}: {each['reason']}" for each in left_out)
    return (
        f"version {version.version} of model {version.model!r} cannot be refreshed: none of its data sets can be used "
        f"({data or 'it names none'}), and its log has {rows} rows to train on, expected at least {least}"
    )


def refreshes_of(model: str) -> Select[JobRow]:
    """Return the query for all refresh jobs of a model."""
    refreshed = JobRow.request["refresh"]["version"].as_integer()
    return select(JobRow).where(JobRow.model == model, refreshed.is_not(None))


def retry(queue: JobQueue, job: str, named: RequestIdentity | None = None) -> Job:
    """Queue a job that repeats a failed or cancelled one. A repeated refresh uses the current serving version and log.

    `named` identifies the request: a repeated request returns the first job. Raise NotFoundError; ConflictError if the
    job has not failed or its inputs were deleted; InvalidRequestError if the job exceeds a limit that is lower now;
    BusyError if the queue is full.
    """
    row = find(queue.database, job)
    if (before := done_before(queue.database, named)) is not None:
        return before
    if row.state not in (FAILED, CANCELLED):
        raise ConflictError(f"{job} is {row.state}: only failed or cancelled jobs can be repeated")
    try:
        again = row.request.get("refresh")
        if again is not None:
            return refresh(queue, row.model, again["trigger"], row.id, named)
        request = JobRequest.model_validate(
            {name: row.request[name] for name in JobRequest.model_fields if name in row.request}
        )
        return create(queue, request, retry_of=row.id, named=named)
    except NotFoundError as error:
        raise ConflictError(f"{job} cannot be repeated: {error.message}") from None
