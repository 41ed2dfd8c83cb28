"""Calls about data sets and robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from lipserve.asking import Reading, query_of
from lipserve.call import KEY_HEADER, Call, Page, Route, given, new_key, nothing, page, record, route
from lipserve.media_types import MEDIA_TYPE_OF, SUFFIXES
from lipserve.records.datasets import Dataset
from lipserve.records.robots import Robot, RobotProfile
from lipserve.results.series import Preview, read_preview

UPLOAD_TIMEOUT = 600.0
"""Longest wait for a recording to be read and prepared, s."""


@route("POST", "/v1/datasets", repeatable=True)
def upload(
    at: Route,
    path: Path | str,
    name: str | None = None,
    *,
    progress: bool = False,
    idempotency_key: str | None = None,
    **reading: Unpack[Reading],
) -> Call[Dataset]:
    """Upload a recording; raise ValueError for an ending that says no format, ApiError where it is refused.

    progress: show a progress bar; idempotency_key: uploads of the same file under the same key make one data set, also
    from another client; reading: how it is to be read and prepared, such as `robot="panda"` or `units={"q": "deg"}`.
    """
    path = Path(path)
    media_type = MEDIA_TYPE_OF.get(path.suffix.lower())
    if media_type is None:
        raise ValueError(f"file is {path.name!r}, expected the ending {', '.join(SUFFIXES)}")
    return at(
        record(Dataset),
        names={},
        params={"name": name or path.name, **query_of(reading)},
        headers={"content-type": media_type, KEY_HEADER: idempotency_key or new_key()},
        file=path,
        timeout=UPLOAD_TIMEOUT,
        shown=f"uploading {path.name}" if progress else None,
    )


@route("GET", "/v1/datasets")
def datasets(at: Route, upload_sha256: str | None = None) -> Call[Page[Dataset]]:
    """All data sets, newest first; upload_sha256: only those of files with this sha256, however they were read."""
    return at(page(Dataset), names={}, params=given(upload_sha256=upload_sha256))


@route("GET", "/v1/datasets/{dataset}")
def dataset(at: Route, dataset: str) -> Call[Dataset]:
    """One data set with its report; raise ApiError where there is none."""
    return at(record(Dataset), names={"dataset": dataset})


@route("GET", "/v1/datasets/{dataset}/preview")
def preview(
    at: Route, dataset: str, quantities: Sequence[str] | None = None, points: int | None = None
) -> Call[Preview]:
    """A data set thinned for a plot so that no extreme is lost.

    quantities: some of q, dq, ddq, tau; points: most of one column.
    """
    params = {"quantities": None if quantities is None else ",".join(quantities), "points": points}
    return at(read_preview, names={"dataset": dataset}, params=params)


@route("DELETE", "/v1/datasets/{dataset}")
def delete_dataset(at: Route, dataset: str) -> Call[None]:
    """Delete a data set, for good; models trained on it stay."""
    return at(nothing, names={"dataset": dataset}, removes=True)


@route("POST", "/v1/robots")
def upload_robot(at: Route, path: Path | str, name: str | None = None) -> Call[Robot]:
    """Upload a URDF; raise ApiError where it is refused."""
    headers = {"content-type": "application/xml"}
    return at(record(Robot), names={}, params=given(name=name), headers=headers, file=Path(path))


@route("GET", "/v1/robots")
def robots(at: Route) -> Call[Page[Robot]]:
    """All uploaded robots, newest first."""
    return at(page(Robot), names={})


@route("GET", "/v1/robots/{robot}")
def robot(at: Route, robot: str) -> Call[Robot]:
    """One uploaded robot."""
    return at(record(Robot), names={"robot": robot})


@route("DELETE", "/v1/robots/{robot}")
def delete_robot(at: Route, robot: str) -> Call[None]:
    """Delete an uploaded robot; models trained with it keep their copy."""
    return at(nothing, names={"robot": robot}, removes=True)


@route("GET", "/v1/robots/profiles")
def profiles(at: Route) -> Call[list[RobotProfile]]:
    """Every robot that is known by name: joints, limits, what its effort means."""
    return at(lambda answer: page(RobotProfile)(answer).items, names={})


@route("GET", "/v1/robots/profiles/{name}")
def profile(at: Route, name: str) -> Call[RobotProfile]:
    """One robot by name, or by the id of an uploaded URDF."""
    return at(record(RobotProfile), names={"name": name})
