"""Calls for training jobs, models, versions, aliases, archives and the audit log."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from lipserve.call import (
    KEY_HEADER,
    Answer,
    Call,
    Page,
    Route,
    given,
    new_key,
    nothing,
    page,
    record,
    route,
    split_name,
)
from lipserve.records.audit import AuditEntry
from lipserve.records.jobs import Job
from lipserve.records.models import Alias, Model
from lipserve.records.overview import ModelOverview
from lipserve.results.arm import Version
from lipserve.states import PromotionOption


@route("POST", "/v1/jobs", repeatable=True)
def train(
    _route: Route,
    model: str,
    datasets: Sequence[str],
    estimator: str | None = None,
    joint_types: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    robot: str | Literal[False] | None = None,
    holdout: Mapping[str, Any] | Literal[False] | None = None,
    promotion: PromotionOption | None = None,
    base: str | None = None,
    *,
    idempotency_key: str | None = None,
) -> Call[Job]:
    """Queue a training job.

    Args:
        model: Name of the model. The job adds a version.
        datasets: Ids or names of data sets.
        estimator: Name of the estimator. Default: `auto`, which compares several.
        joint_types: (n,) `revolute` or `prismatic`. Default: those of the data sets' robot, else all revolute.
        options: Fit options; see `options` of POST /v1/jobs.
        robot: Profile such as panda, or id of an uploaded URDF, for rigid-body estimators. Default: the robot of the
            data sets; False for none.
        holdout: Part to hold out for evaluation, {"share": 0.3} by default; False for none. The version is then
            trained on all samples, unless the part has {"only": True}.
        promotion: `ask`: the version becomes the serving version if its verdict is usable; `always`:
            in any case. Default: the service's setting.
        base: Version of another unit of the same robot to start from, as `model@3` or `model@alias`.
        idempotency_key: The same request with the same key queues one job, also from other clients.

    Returns:
        The queued job; see `wait`.

    Raises:
        ApiError: The request is invalid.

    Example:
        >>> job = client.wait(client.train("my-arm", ["ds_0123456789abcdef"]))
        >>> job.state, job.version
        ('succeeded', 1)
    """
    body = _training_body(model, datasets, estimator, joint_types, options, robot, holdout, promotion, base)
    return _route(record(Job), names={}, json=body, headers={KEY_HEADER: idempotency_key or new_key()})


@route("POST", "/v1/jobs/check")
def check_training(
    _route: Route,
    model: str,
    datasets: Sequence[str] = (),
    estimator: str | None = None,
    joint_types: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    robot: str | Literal[False] | None = None,
    holdout: Mapping[str, Any] | Literal[False] | None = None,
    promotion: PromotionOption | None = None,
    base: str | None = None,
) -> Call[None]:
    """Check the arguments of `train` before recordings are uploaded; raise ApiError if they are invalid.

    Without `datasets`, checks that depend on the data are skipped.
    """
    body = _training_body(model, datasets, estimator, joint_types, options, robot, holdout, promotion, base)
    return _route(nothing, names={}, json=body)


def _training_body(
    model: str,
    datasets: Sequence[str],
    estimator: str | None,
    joint_types: Sequence[str] | None,
    options: Mapping[str, Any] | None,
    robot: str | Literal[False] | None,
    holdout: Mapping[str, Any] | Literal[False] | None,
    promotion: PromotionOption | None,
    base: str | None,
) -> dict[str, Any]:
    """Return the body of a training request."""
    body = {"model": model, "datasets": list(datasets), "options": dict(options or {})} | given(
        estimator=estimator,
        joint_types=None if joint_types is None else list(joint_types),
        robot=robot or None,
        holdout=dict(holdout) if holdout else None,
        promotion=promotion,
        base=base,
    )
    # explicit null: a missing field means the service's default
    body |= {name: None for name, value in (("holdout", holdout), ("robot", robot)) if value is False}
    return body


@route("GET", "/v1/jobs")
def jobs(_route: Route) -> Call[Page[Job]]:
    """List jobs, newest first."""
    return _route(page(Job), names={})


@route("GET", "/v1/jobs/{job}")
def job(_route: Route, job: str) -> Call[Job]:
    """Return a job with its progress."""
    return _route(record(Job), names={"job": job})


@route("GET", "/v1/jobs/{job}/events")
def job_events(_route: Route, job: str) -> Call[Job]:
    """Follow a job: yield it now and after every change, until it ends or the service stops."""
    return _route(record(Job), names={"job": job})


@route("POST", "/v1/jobs/{job}/cancel")
def cancel(_route: Route, job: str) -> Call[Job]:
    """Cancel a job."""
    return _route(record(Job), names={"job": job})


@route("POST", "/v1/jobs/{job}/retry", repeatable=True)
def retry(_route: Route, job: str, *, idempotency_key: str | None = None) -> Call[Job]:
    """Queue a failed or cancelled job again, as a new job."""
    return _route(record(Job), names={"job": job}, headers={KEY_HEADER: idempotency_key or new_key()})


ARCHIVE_TIMEOUT = 600.0
"""Max time for the service to pack or check an archive, s."""
FILE_FORMATS = ("archive", "urdf", "mjcf", "torch")
"""Formats of one file. The others are folders, sent as a tar."""


@route("GET", "/v1/models")
def models(_route: Route) -> Call[Page[Model]]:
    """List models with their versions, newest first."""
    return _route(page(Model), names={})


@route("GET", "/v1/overview")
def overview(_route: Route) -> Call[Page[ModelOverview]]:
    """List summaries of models, newest first: arm, quality, recent observations, pending decisions."""
    return _route(page(ModelOverview), names={})


@route("GET", "/v1/models/{model}")
def model(_route: Route, model: str) -> Call[Model]:
    """Return a model with its versions."""
    return _route(record(Model), names={"model": model})


@route("DELETE", "/v1/models/{model}")
def delete_model(_route: Route, model: str) -> Call[None]:
    """Delete a model with its versions and observations permanently."""
    return _route(nothing, names={"model": model}, removes=True)


@route("GET", "/v1/models/{model}/versions/{version}")
def version(_route: Route, model: str, version: int) -> Call[Version]:
    """Return a version of a model. Its property `arm` is the estimated arm; `print` shows it."""
    return _route(record(Version), names={"model": model, "version": version})


@route("PATCH", "/v1/models/{model}/versions/{version}")
def annotate(
    _route: Route, model: str, version: int, note: str | None = None, tags: Sequence[str] | None = None
) -> Call[Version]:
    """Set the note and the tags of a version; those that are None stay.

    Args:
        model: Name of the model.
        version: Version number.
        note: Text of at most 500 characters; "" removes the note.
        tags: At most 10 tags of at most 40 characters; [] removes them.

    Example:
        >>> client.annotate("my-arm", 1, note="before the new gripper", tags=["line 2"]).tags
        ['line 2']
    """
    body = given(note=note, tags=None if tags is None else list(tags))
    return _route(record(Version), names={"model": model, "version": version}, json=body)


@route("DELETE", "/v1/models/{model}/versions/{version}")
def delete_version(_route: Route, model: str, version: int) -> Call[None]:
    """Delete a version that is not in use permanently."""
    return _route(nothing, names={"model": model, "version": version}, removes=True)


@route("GET", "/v1/models/{model}/aliases")
def aliases(_route: Route, model: str) -> Call[list[Alias]]:
    """Return the aliases of a model, `serving` first."""
    return _route(lambda answer: page(Alias)(answer).items, names={"model": model})


@route("PUT", "/v1/models/{model}/aliases/{alias}")
def set_alias(_route: Route, model: str, alias: str, version: int | str, override: bool = False) -> Call[Alias]:
    """Point an alias to a version, or to the version of another alias. `serving` sets the serving version.

    override: move it even if the version is not usable by its verdict.
    """
    body = {"alias": version} if isinstance(version, str) else {"version": version}
    return _route(record(Alias), names={"model": model, "alias": alias}, json={**body, "override": override})


@route("PUT", "/v1/models/{model}/thresholds")
def set_thresholds(
    _route: Route,
    model: str,
    max_error: float | None = None,
    min_coverage: float | None = None,
    max_width: float | None = None,
) -> Call[Model]:
    """Replace the thresholds of a model's verdicts; those that are None get their defaults.

    Args:
        model: Name of the model.
        max_error: Max mean squared error of a joint, as a share of the variance of its torque.
        min_coverage: Min coverage of the 95 % intervals, within sampling error.
        max_width: Max width of the 95 % intervals, relative to those of the mean torque.

    Example:
        >>> client.set_thresholds("my-arm", max_error=0.25).thresholds.max_error
        0.25
    """
    thresholds = given(max_error=max_error, min_coverage=min_coverage, max_width=max_width)
    return _route(record(Model), names={"model": model}, json=thresholds)


@route("DELETE", "/v1/models/{model}/aliases/{alias}")
def remove_alias(_route: Route, model: str, alias: str) -> Call[None]:
    """Remove an alias. Its version stays."""
    return _route(nothing, names={"model": model, "alias": alias}, removes=True)


@route("POST", "/v1/models/{model}/aliases/{alias}/rollback")
def rollback_alias(_route: Route, model: str, alias: str) -> Call[Alias]:
    """Undo the last move of an alias; if repeated, the one before it."""
    return _route(record(Alias), names={"model": model, "alias": alias})


@route("GET", "/v1/models/{model}/export")
def export(
    _route: Route,
    model: str,
    path: Path | str,
    version: int | None = None,
    alias: str | None = None,
    learnt: bool = True,
    format: Literal["archive", "urdf", "mjcf", "c", "onnx", "torch", "jax"] = "archive",  # noqa: A002 - the API's own name
) -> Call[Path]:
    """Export a version as an archive for `import_model`, or for simulators, planners and control loops.

    Args:
        model: Name of the model, also as `NAME@3` or `NAME@ALIAS`.
        path: File to write; it is written completely or not at all. For `c`, `onnx` and `jax`: the folder.
        version: Version number. Default: the serving version.
        alias: Alias of the version, instead of its number.
        learnt: Include what was learnt online; else export the version as trained.
        format: `archive`; a function of any estimator as `onnx` (a model repository of Triton), `torch` or `jax`; for
            rigid-body models only, `urdf`, `mjcf` (MuJoCo), or `c` for `lipserve_model.c` and `lipserve_model.h`.

    Returns:
        The path.

    Example:
        >>> client.export("my-arm", "my-arm.xml", format="mjcf").name
        'my-arm.xml'
    """
    path = Path(path)

    def read(answer: Answer) -> Path:
        if format not in FILE_FORMATS:
            path.mkdir(parents=True, exist_ok=True)
            with tarfile.open(fileobj=io.BytesIO(answer.body)) as archive:
                archive.extractall(path, filter="data")
        return path

    name, which = split_name(model, version, alias)
    params = which | {"learnt": learnt, "format": format}
    save_to = path if format in FILE_FORMATS else None
    return _route(read, names={"model": name}, params=params, save_to=save_to, timeout=ARCHIVE_TIMEOUT)


@route("POST", "/v1/models/import")
def import_model(
    _route: Route, path: Path | str, name: str | None = None, promotion: PromotionOption | None = None
) -> Call[Version]:
    """Import an exported archive as a new version.

    Args:
        path: Archive written by `export`.
        name: Name of the model. Default: the name in the archive.
        promotion: `ask`: the version becomes the serving version if the model had none and it passes the check on
            held-out data; `always`: in any case.

    Returns:
        The new version.

    Raises:
        ApiError: The service rejects the archive.
    """
    headers = {"content-type": "application/x-tar"}
    return _route(
        record(Version),
        names={},
        params=given(name=name, promotion=promotion),
        headers=headers,
        file=Path(path),
        timeout=ARCHIVE_TIMEOUT,
    )


@route("GET", "/v1/audit")
def audit(
    _route: Route,
    model: str | None = None,
    key: str | None = None,
    change: str | None = None,
    since: str | None = None,
    until: str | None = None,
) -> Call[Page[AuditEntry]]:
    """List changes to models, newest first.

    Args:
        model: Only changes to this model.
        key: Only changes made with the API key of this id.
        change: Only this kind of change, e.g. `alias moved`.
        since: Only changes at or after this time: ISO 8601 with a zone, e.g. 2026-11-24T08:00:00Z.
        until: Only changes before this time.
    """
    params = {"model": model, "key": key, "change": change, "since": since, "until": until}
    return _route(page(AuditEntry), names={}, params=params)
