"""Routes of data sets."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response, status

from service.api.access.scopes import READ, TRAIN, needs
from service.api.dependencies import KeyHeader, PageQuery, StorageDep, UploadsDep
from service.api.errors import responses
from service.api.limits.upload import Kinds, receive_to
from service.api.route import Route
from service.contract.datasets import Dataset, DatasetPage, Preview
from service.contract.media_types import MEDIA_TYPES, SUFFIXES
from service.contract.uploads import UPLOAD_BODY, RereadQuery, UploadQuery
from service.datasets import store
from service.datasets.options import upload_options
from service.datasets.staging import QUANTITIES
from service.foundation.errors import (
    ConflictError,
    DamagedDataError,
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    NotInstalledError,
    TooLargeError,
    UnsupportedMediaTypeError,
    invalid_request,
)
from service.storage.rows import identify_request

router = APIRouter(
    prefix="/v1/datasets", tags=["data sets"], responses=responses(InvalidRequestError), route_class=Route
)


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a recording",
    responses=responses(
        InvalidDataError,
        InvalidRequestError,
        TooLargeError,
        UnsupportedMediaTypeError,
        ConflictError,
        NotInstalledError,
    ),
    openapi_extra=UPLOAD_BODY,
)
@needs(TRAIN)
async def upload(
    request: Request,
    response: Response,
    storage: StorageDep,
    turns: UploadsDep,
    query: Annotated[UploadQuery, Query()],
    idempotency_key: KeyHeader = None,
) -> Dataset:
    """Check a recording, prepare it and store it as a data set, which never changes.

    A wrong recording is rejected: `detail` names the column or row and what was expected.
    """
    upload_options(query)  # rejects wrong options before the body is read
    path = storage.files.upload()
    try:
        kind, file_name = await receive_to(request, path, Kinds(MEDIA_TYPES, SUFFIXES), storage.disk)
        asked = (sorted(request.query_params.multi_items()), kind, file_name)
        named = await to_thread.run_sync(partial(identify_request, idempotency_key, *asked, file=path))
        called = query.name or file_name or "unnamed"
        dataset = await to_thread.run_sync(store.add, storage, path, kind, called, query, named, limiter=turns)
    finally:
        path.unlink(missing_ok=True)
    response.headers["Location"] = f"/v1/datasets/{dataset.id}"
    return dataset


@router.post(
    "/{dataset}/read",
    status_code=status.HTTP_201_CREATED,
    summary="Read the file of a data set again",
    responses=responses(
        InvalidDataError,
        InvalidRequestError,
        NotFoundError,
        DamagedDataError,
        ConflictError,
        NotInstalledError,
    ),
)
@needs(TRAIN)
async def read_again(
    request: Request,
    response: Response,
    storage: StorageDep,
    turns: UploadsDep,
    dataset: str,
    query: Annotated[RereadQuery, Query()],
    idempotency_key: KeyHeader = None,
) -> Dataset:
    """Read the uploaded file with further options, without another upload, and return a new data set.

    The old data set is deleted unless a job used it.
    """
    named = identify_request(idempotency_key, dataset, sorted(request.query_params.multi_items()))
    made = await to_thread.run_sync(store.read_again, storage, dataset, query, named, limiter=turns)
    response.headers["Location"] = f"/v1/datasets/{made.id}"
    return made


@router.get("", summary="List data sets, newest first")
@needs(READ)
def list_datasets(
    storage: StorageDep,
    page: PageQuery,
    upload_sha256: Annotated[
        str | None, Query(pattern="^[0-9a-f]{64}$", description="Only data sets made from a file with this sha256")
    ] = None,
) -> DatasetPage:
    """Return one page of data sets with their reports."""
    return store.page(storage.database, page, upload_sha256)


@router.get("/{dataset}", summary="Retrieve a data set and its report", responses=responses(NotFoundError))
@needs(READ)
def show(storage: StorageDep, dataset: str) -> Dataset:
    """Return a data set with its report: what the recording contained and what was derived from it."""
    return store.show(storage.database, dataset)


@router.get(
    "/{dataset}/preview",
    summary="Retrieve points of a data set for a plot",
    responses=responses(NotFoundError, DamagedDataError),
)
@needs(READ)
def preview(
    storage: StorageDep,
    dataset: str,
    quantities: Annotated[
        str, Query(max_length=100, description="Any of q, dq, ddq, tau; separated by commas")
    ] = ",".join(QUANTITIES),
    points: Annotated[
        int, Query(ge=2, le=store.MAX_PREVIEW_POINTS, description="Max points per column")
    ] = store.MAX_PREVIEW_POINTS,
) -> Preview:
    """Return columns of a data set, reduced to at most `points` rows. Minima and maxima stay visible."""
    names = [name.strip() for name in quantities.split(",")]
    for name in names:
        if name not in QUANTITIES or names.count(name) > 1:
            raise invalid_request("quantities", name, f"each of {', '.join(QUANTITIES)} at most once")
    return store.preview(storage, dataset, names, points)


@router.delete(
    "/{dataset}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a data set",
    responses=responses(NotFoundError, ConflictError),
)
@needs(TRAIN)
def delete(storage: StorageDep, dataset: str) -> None:
    """Delete a data set with its samples. Models trained on it stay."""
    store.delete(storage, dataset)
