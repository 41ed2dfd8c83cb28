"""Routes of data sets."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response, status

from lipcore.model import TorqueConvention
from lipcore.signals import CUTOFF
from service.context import ServiceDep
from service.datasets import store
from service.datasets.schema import UPLOAD_BODY, Dataset, DatasetPage
from service.errors import (
    ConflictError,
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnsupportedMediaTypeError,
    responses,
)
from service.limits.upload import Kinds, receive_to
from service.names import NameForPeople
from service.pages import PageQuery
from service.route import Route

KINDS = Kinds({"text/csv": "csv", "application/x-npz": "npz"}, {".csv": "csv", ".npz": "npz"})

router = APIRouter(
    prefix="/v1/datasets", tags=["data sets"], responses=responses(InvalidRequestError), route_class=Route
)


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a recording",
    responses=responses(InvalidDataError, InvalidRequestError, TooLargeError, UnsupportedMediaTypeError),
    openapi_extra=UPLOAD_BODY,
)
async def upload(
    request: Request,
    response: Response,
    service: ServiceDep,
    name: Annotated[NameForPeople | None, Query(description="A name for people; the file's by default")] = None,
    joint_names: Annotated[
        str | None, Query(max_length=4000, description="Names of joints 1..n, separated by commas")
    ] = None,
    torque_convention: Annotated[
        TorqueConvention, Query(description="Whether `tau` is the whole joint torque or what is added to gravity")
    ] = "gravity_included",
    cutoff: Annotated[
        float, Query(gt=0, le=1000, allow_inf_nan=False, description="Low-pass for derived quantities, Hz")
    ] = CUTOFF,
) -> Dataset:
    """Validate a recording and store it as an immutable data set, or say what is wrong and where."""
    names = None if joint_names is None else tuple(part.strip() for part in joint_names.split(","))
    path = service.files.upload()
    try:
        kind, file_name = await receive_to(request, path, KINDS, service.disk)
        dataset = await to_thread.run_sync(
            store.add, service, path, kind, name or file_name or "unnamed", names, torque_convention, cutoff
        )
    finally:
        path.unlink(missing_ok=True)
    response.headers["Location"] = f"/v1/datasets/{dataset.id}"
    return dataset


@router.get("", summary="List data sets, newest first")
def list_datasets(service: ServiceDep, page: PageQuery) -> DatasetPage:
    """One page of data sets with their reports."""
    return store.page(service.database, page)


@router.get("/{dataset}", summary="One data set and its report", responses=responses(NotFoundError))
def show(service: ServiceDep, dataset: str) -> Dataset:
    """What was found in the recording and what was derived."""
    return store.show(service.database, dataset)


@router.delete(
    "/{dataset}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a data set",
    responses=responses(NotFoundError, ConflictError),
)
def delete(service: ServiceDep, dataset: str) -> None:
    """Delete the samples. Models trained on them stay."""
    store.delete(service, dataset)
