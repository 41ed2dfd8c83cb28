"""Calls for data sets and robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Unpack

from lipserve.asking import Reading, query_of
from lipserve.call import KEY_HEADER, Call, Page, Route, given, new_key, nothing, page, record, route
from lipserve.media_types import MEDIA_TYPE_OF, SUFFIXES
from lipserve.records.datasets import Dataset
from lipserve.records.robots import Robot, RobotProfile
from lipserve.results.series import Preview, read_preview

UPLOAD_TIMEOUT = 600.0
"""Max time for the service to read and prepare a recording, s."""


@route("POST", "/v1/datasets", repeatable=True)
def upload(
    _route: Route,
    path: Path | str,
    name: str | None = None,
    *,
    progress: bool = False,
    idempotency_key: str | None = None,
    **reading: Unpack[Reading],
) -> Call[Dataset]:
    """Upload a recording as a new data set.

    Args:
        path: File: CSV, NPZ, Parquet, JSON, a ROS bag, MCAP or a zip; the suffix selects the format.
        name: Name of the data set. Default: the file's name.
        progress: Show a progress bar.
        idempotency_key: Uploads of the same file with the same key give one data set, also from other clients.
        **reading: Options for reading and preparing the file, e.g. robot="panda" or units={"q": "deg"}.

    Returns:
        The data set with its report.

    Raises:
        ValueError: The suffix is unknown.
        ApiError: The service rejects the file.

    Example:
        >>> client.upload("run.csv", robot="panda", units={"q": "deg"}).id
        'ds_0123456789abcdef'
    """
    path = Path(path)
    media_type = MEDIA_TYPE_OF.get(path.suffix.lower())
    if media_type is None:
        raise ValueError(f"file is {path.name!r}, expected one of the suffixes {', '.join(SUFFIXES)}")
    return _route(
        record(Dataset),
        names={},
        params={"name": name or path.name, **query_of(reading)},
        headers={"content-type": media_type, KEY_HEADER: idempotency_key or new_key()},
        file=path,
        timeout=UPLOAD_TIMEOUT,
        shown=f"uploading {path.name}" if progress else None,
    )


@route("POST", "/v1/datasets/{dataset}/read", repeatable=True)
def read_again(
    _route: Route,
    dataset: str,
    *,
    fresh: bool = False,
    idempotency_key: str | None = None,
    **reading: Unpack[Reading],
) -> Call[Dataset]:
    """Read the file of a data set with further options, without another upload.

    Args:
        dataset: Id or name of the data set. It is deleted afterwards unless a job used it.
        fresh: Use only these options. By default, those of the upload stay if they are not given.
        idempotency_key: Calls with the same key give one data set, also from other clients.
        **reading: Options as of `upload`.

    Returns:
        The new data set with its report.

    Raises:
        ApiError: The service rejects the file with these options.

    Example:
        >>> client.read_again("ds_0123456789abcdef", torque_factors=[1, -1]).id
        'ds_fedcba9876543210'
    """
    return _route(
        record(Dataset),
        names={"dataset": dataset},
        params={**query_of(reading), **({"fresh": "true"} if fresh else {})},
        headers={KEY_HEADER: idempotency_key or new_key()},
        timeout=UPLOAD_TIMEOUT,
    )


@route("GET", "/v1/datasets")
def datasets(_route: Route, upload_sha256: str | None = None) -> Call[Page[Dataset]]:
    """List data sets, newest first. upload_sha256: only those made from files with this SHA-256."""
    return _route(page(Dataset), names={}, params=given(upload_sha256=upload_sha256))


@route("GET", "/v1/datasets/{dataset}")
def dataset(_route: Route, dataset: str) -> Call[Dataset]:
    """Return a data set with its report, by id or name."""
    return _route(record(Dataset), names={"dataset": dataset})


@route("GET", "/v1/datasets/{dataset}/preview")
def preview(
    _route: Route, dataset: str, quantities: Sequence[str] | None = None, points: int | None = None
) -> Call[Preview]:
    """Return a data set thinned for a plot, with all extremes kept.

    Args:
        dataset: Id or name of the data set.
        quantities: Some of q, dq, ddq, tau. Default: all.
        points: Max number of points of one column.
    """
    params = {"quantities": None if quantities is None else ",".join(quantities), "points": points}
    return _route(read_preview, names={"dataset": dataset}, params=params)


@route("DELETE", "/v1/datasets/{dataset}")
def delete_dataset(_route: Route, dataset: str) -> Call[None]:
    """Delete a data set permanently. Models trained on it stay."""
    return _route(nothing, names={"dataset": dataset}, removes=True)


@route("POST", "/v1/robots")
def upload_robot(
    _route: Route,
    path: Path | str,
    name: str | None = None,
    scale: Mapping[str, float] | None = None,
    xacro: Mapping[str, str] | None = None,
) -> Call[Robot]:
    """Upload a robot.

    Args:
        path: A URDF, a xacro, MuJoCo's MJCF, or the zip of a folder with one of them and the files that it includes.
        name: Name of the robot.
        scale: Factors of `length`, `mass` and `inertia` to m, kg and kg·m², for a URDF in other units.
        xacro: Arguments of a xacro by name.
    """
    headers = {"content-type": "application/zip" if Path(path).suffix == ".zip" else "application/xml"}
    factors = None if scale is None else ",".join(f"{quantity}={factor:g}" for quantity, factor in scale.items())
    arguments = None if xacro is None else ",".join(f"{argument}={value}" for argument, value in xacro.items())
    params = given(name=name, scale=factors, xacro=arguments)
    return _route(record(Robot), names={}, params=params, headers=headers, file=Path(path))


@route("GET", "/v1/robots")
def robots(_route: Route) -> Call[Page[Robot]]:
    """List uploaded robots, newest first."""
    return _route(page(Robot), names={})


@route("GET", "/v1/robots/{robot}")
def robot(_route: Route, robot: str) -> Call[Robot]:
    """Return an uploaded robot."""
    return _route(record(Robot), names={"robot": robot})


@route("DELETE", "/v1/robots/{robot}")
def delete_robot(_route: Route, robot: str) -> Call[None]:
    """Delete an uploaded robot. Models trained with it keep a copy."""
    return _route(nothing, names={"robot": robot}, removes=True)


@route("GET", "/v1/robots/profiles")
def profiles(_route: Route) -> Call[list[RobotProfile]]:
    """Return all robot profiles: joints, limits, meaning of their effort."""
    return _route(lambda answer: page(RobotProfile)(answer).items, names={})


@route("GET", "/v1/robots/profiles/{name}")
def profile(_route: Route, name: str) -> Call[RobotProfile]:
    """Return a robot profile, by name or by the id of an uploaded URDF."""
    return _route(record(RobotProfile), names={"name": name})
