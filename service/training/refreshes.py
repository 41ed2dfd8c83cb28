"""Refreshes, which train the version that serves anew on its data sets and on what was observed since, and repeats of
jobs that failed or were cancelled."""

from __future__ import annotations

from typing import Literal

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, NotFoundError, not_found
from service.foundation.settings import Settings
from service.foundation.states import ACTIVE, CANCELLED, FAILED
from service.journal import log
from service.models import registry
from service.storage.database import JobRow, VersionRow
from service.training import jobs, refresh_data
from service.training.queue import JobQueue
from service.training.schema import Job, JobRequest
from service.web.rows import Identity, done

Trigger = Literal["novelty", "linearisation", "asked"]


def ask(
    queue: JobQueue,
    model: str,
    trigger: Trigger = "asked",
    retry_of: str | None = None,
    named: Identity | None = None,
) -> Job:
    """Queue a refresh of the version that serves; return its job. Not for the event loop.

    retry_of: the job that it repeats; named: the request, where its client has named it.
    Raise NotFoundError, BusyError for a full queue, ConflictError where a refresh of the model is under way or there is
    nothing to train on.
    """
    version = registry.find(queue.database, model, None)
    with queue.database.transaction() as session:
        if (before := done(session, JobRow, named)) is not None:
            return jobs.shown(before)
        job = add(session, queue.settings, version, trigger, retry_of, named)
    queue.submit(job.id)
    return jobs.shown(job)


def add(
    session: Session,
    settings: Settings,
    version: VersionRow,
    trigger: Trigger,
    retry_of: str | None = None,
    named: Identity | None = None,
) -> JobRow:
    """Add the job of a refresh; raise ConflictError or BusyError."""
    model, manifest = version.model, version.manifest
    if not registry.exists(session, model, version.version):  # deleted since it was found
        raise not_found("version", version.version)
    for job in session.scalars(of(model).where(JobRow.state.in_(ACTIVE))):
        raise ConflictError(f"{job.id} refreshes model {model!r} already: wait for its end or cancel it")
    through = log.newest(session, model)
    scope = refresh_data.scope_of(session, model, through)
    kept, left_out = refresh_data.split_datasets(session, scope, manifest["lineage"])
    rows = refresh_data.rows_within(session, model, scope)
    if not kept and rows < settings.min_samples:
        raise ConflictError(_nothing(version, rows, left_out, settings.min_samples))
    made_by = None if version.job is None else session.scalar(select(JobRow).where(JobRow.id == version.job))
    request = {
        "model": model,
        "datasets": [row.id for row in kept],
        "estimator": manifest["estimator"],
        "joint_types": manifest["joint_types"],
        "robot": made_by.request.get("robot") if made_by is not None and "robot" in manifest else None,
        "options": manifest["options"],
        "refresh": {"version": version.version, "through": through, "trigger": trigger},
    }
    return jobs.add(session, settings, model, request, retry_of, named)


def _nothing(version: VersionRow, rows: int, left_out: list[dict[str, str]], least: int) -> str:
    data = "; ".join(f"data set {each['id']!r} is left out: {each['reason']}" for each in left_out)
    return (
        f"version {version.version} of model {version.model!r} cannot be refreshed: its log has {rows} rows to train "
        f"on, expected at least {least} where none of its data sets is left ({data or 'it names none'})"
    )


def of(model: str) -> Select[JobRow]:
    """Jobs that refresh a model."""
    refreshed = JobRow.request["refresh"]["version"].as_integer()
    return select(JobRow).where(JobRow.model == model, refreshed.is_not(None))


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
        raise ConflictError(f"{job} is {row.state}: only one that has failed or was cancelled can be repeated")
    try:
        again = row.request.get("refresh")
        if again is not None:
            return ask(queue, row.model, again["trigger"], row.id, named)
        request = JobRequest.model_validate(
            {name: row.request[name] for name in JobRequest.model_fields if name in row.request}  # older ones lack some
        )
        return jobs.create(queue, request, retry_of=row.id, named=named)
    except NotFoundError as error:
        raise ConflictError(f"{job} cannot be repeated: {error.message}") from None
