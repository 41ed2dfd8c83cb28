"""Calls about training jobs, and about models, their versions, aliases and archives, and what changed them."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from lipserve.call import KEY_HEADER, Answer, Call, Page, Route, given, new_key, nothing, page, record, route
from lipserve.records.audit import AuditEntry
from lipserve.records.jobs import Job
from lipserve.records.models import Alias, Model
from lipserve.records.overview import ModelOverview
from lipserve.results.arm import Version
from lipserve.states import PromotionOption


@route("POST", "/v1/jobs", repeatable=True)
def train(
    at: Route,
    model: str,
    datasets: Sequence[str],
    estimator: str | None = None,
    joint_types: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    robot: str | None = None,
    holdout: Mapping[str, Any] | Literal[False] | None = None,
    promotion: PromotionOption | None = None,
    base: str | None = None,
    *,
    idempotency_key: str | None = None,
) -> Call[Job]:
    """Queue a training job.

    robot: for rigid bodies, a profile such as panda or the id of an uploaded URDF; holdout: what to hold out of the
    data sets and judge the version on, {"share": 0.3} by default, False for nothing. The version then learns it, too,
    unless that is {"only": True}. promotion: `ask` (default) lets the version answer if it does well there, `always` in
    any case; base: a version of another unit of the same robot to start from, as `model:3` or `model@alias`;
    idempotency_key: the same request under the same key queues one job, also from another client.
    """
    body = _asked(model, datasets, estimator, joint_types, options, robot, holdout, promotion, base)
    return at(record(Job), names={}, json=body, headers={KEY_HEADER: idempotency_key or new_key()})


@route("POST", "/v1/jobs/check")
def check_training(
    at: Route,
    model: str,
    datasets: Sequence[str] = (),
    estimator: str | None = None,
    joint_types: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    robot: str | None = None,
    holdout: Mapping[str, Any] | Literal[False] | None = None,
    promotion: PromotionOption | None = None,
    base: str | None = None,
) -> Call[None]:
    """Check what `train` would be asked, before its recordings are uploaded; raise ApiError where that is wrong.

    datasets: those that are there already; without any, what depends on the data is not checked.
    """
    body = _asked(model, datasets, estimator, joint_types, options, robot, holdout, promotion, base)
    return at(nothing, names={}, json=body)


def _asked(
    model: str,
    datasets: Sequence[str],
    estimator: str | None,
    joint_types: Sequence[str] | None,
    options: Mapping[str, Any] | None,
    robot: str | None,
    holdout: Mapping[str, Any] | Literal[False] | None,
    promotion: PromotionOption | None,
    base: str | None,
) -> dict[str, Any]:
    """The body of a request to train."""
    body = {"model": model, "datasets": list(datasets), "options": dict(options or {})} | given(
        estimator=estimator,
        joint_types=None if joint_types is None else list(joint_types),
        robot=robot,
        holdout=dict(holdout) if holdout else None,
        promotion=promotion,
        base=base,
    )
    if holdout is False:
        body["holdout"] = None  # said: left out it is the service's default
    return body


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


ARCHIVE_TIMEOUT = 600.0
"""Longest wait for an archive to be packed or checked, s."""
C_FILES = ("lipserve_model.c", "lipserve_model.h")
"""What a version as C is."""


@route("GET", "/v1/models")
def models(at: Route) -> Call[Page[Model]]:
    """All models with their versions, newest first."""
    return at(page(Model), names={})


@route("GET", "/v1/overview")
def overview(at: Route) -> Call[Page[ModelOverview]]:
    """All models at a glance, newest first: arm, quality, what came lately, what needs a decision."""
    return at(page(ModelOverview), names={})


@route("GET", "/v1/models/{model}")
def model(at: Route, model: str) -> Call[Model]:
    """A model with its versions."""
    return at(record(Model), names={"model": model})


@route("DELETE", "/v1/models/{model}")
def delete_model(at: Route, model: str) -> Call[None]:
    """Delete a model with all that it has observed and learnt, for good."""
    return at(nothing, names={"model": model}, removes=True)


@route("GET", "/v1/models/{model}/versions/{version}")
def version(at: Route, model: str, version: int) -> Call[Version]:
    """One version of a model; its `arm` is what it has learnt of its robot, and `print` shows that."""
    return at(record(Version), names={"model": model, "version": version})


@route("DELETE", "/v1/models/{model}/versions/{version}")
def delete_version(at: Route, model: str, version: int) -> Call[None]:
    """Delete a version that nothing needs, for good."""
    return at(nothing, names={"model": model, "version": version}, removes=True)


@route("GET", "/v1/models/{model}/aliases")
def aliases(at: Route, model: str) -> Call[list[Alias]]:
    """Every alias of a model, `serving` first."""
    return at(lambda answer: page(Alias)(answer).items, names={"model": model})


@route("PUT", "/v1/models/{model}/aliases/{alias}")
def set_alias(at: Route, model: str, alias: str, version: int | str) -> Call[Alias]:
    """Point an alias to a version, or to where another alias points; `serving` answers where none is named."""
    body = {"alias": version} if isinstance(version, str) else {"version": version}
    return at(record(Alias), names={"model": model, "alias": alias}, json=body)


@route("DELETE", "/v1/models/{model}/aliases/{alias}")
def remove_alias(at: Route, model: str, alias: str) -> Call[None]:
    """Remove an alias; its version stays."""
    return at(nothing, names={"model": model, "alias": alias}, removes=True)


@route("POST", "/v1/models/{model}/aliases/{alias}/rollback")
def rollback_alias(at: Route, model: str, alias: str) -> Call[Alias]:
    """Take back the last move of an alias, the next time the one before it."""
    return at(record(Alias), names={"model": model, "alias": alias})


@route("GET", "/v1/models/{model}/export")
def export(
    at: Route,
    model: str,
    path: Path | str,
    version: int | None = None,
    alias: str | None = None,
    learnt: bool = True,
    format: Literal["archive", "c"] = "archive",  # noqa: A002 - the API's own name
) -> Call[Path]:
    """Write a version as an archive to `path`, whole or not at all, and return it; see `import_model`.

    The version that serves, unless one is named. learnt: with what it has learnt online, else as it was trained;
    format: `c` writes `lipserve_model.c` and `lipserve_model.h` to the folder `path`, for a model of rigid bodies.
    """
    path = Path(path)

    def read(answer: Answer) -> Path:
        if format == "c":
            path.mkdir(parents=True, exist_ok=True)
            with tarfile.open(fileobj=io.BytesIO(answer.body)) as archive:
                for name in C_FILES:
                    content = archive.extractfile(name)
                    assert content is not None  # a plain file
                    (path / name).write_bytes(content.read())
        return path

    params = given(version=version, alias=alias) | {"learnt": learnt}
    if format == "c":
        return at(read, names={"model": model}, params={**params, "format": format}, timeout=ARCHIVE_TIMEOUT)
    return at(read, names={"model": model}, params=params, save_to=path, timeout=ARCHIVE_TIMEOUT)


@route("GET", "/v1/models/{model}/urdf")
def urdf(at: Route, model: str, version: int | None = None, alias: str | None = None) -> Call[str]:
    """The arm that a version has learnt, as the text of a URDF; raise ApiError for an estimator without rigid bodies.

    The version that serves, unless one is named.
    """
    return at(lambda answer: answer.body.decode(), names={"model": model}, params=given(version=version, alias=alias))


@route("POST", "/v1/models/import")
def import_model(
    at: Route, path: Path | str, name: str | None = None, promotion: PromotionOption | None = None
) -> Call[Version]:
    """Make a new version of an archive that a service has exported; raise ApiError where it is refused.

    name: of the model, that of the archive by default; promotion: `ask`, so that it answers if the model had no version
    and it does well on what its training held out, or `always`.
    """
    headers = {"content-type": "application/x-tar"}
    return at(
        record(Version),
        names={},
        params=given(name=name, promotion=promotion),
        headers=headers,
        file=Path(path),
        timeout=ARCHIVE_TIMEOUT,
    )


@route("GET", "/v1/audit")
def audit(
    at: Route,
    model: str | None = None,
    key: str | None = None,
    change: str | None = None,
    since: str | None = None,
    until: str | None = None,
) -> Call[Page[AuditEntry]]:
    """Who changed what of which model, newest first; of a model, of the API key of an id, or of one kind of change.

    since, until: from a moment on and before another, ISO 8601 with a zone, as 2026-11-24T08:00:00Z.
    """
    params = {"model": model, "key": key, "change": change, "since": since, "until": until}
    return at(page(AuditEntry), names={}, params=params)
