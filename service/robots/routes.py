"""Routes of robots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response, status
from starlette.datastructures import UploadFile

from lipcore.robots import installed_profiles
from service.context import ServiceDep
from service.errors import (
    ConflictError,
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnsupportedMediaTypeError,
    invalid_request,
    problem,
    responses,
)
from service.pages import PageQuery
from service.robots import store
from service.robots.schema import UPLOAD_BODY, ProfileList, Robot, RobotPage

MEDIA_TYPES = ("application/xml", "text/xml")
SUFFIXES = (".urdf", ".xml")

router = APIRouter(prefix="/v1/robots", tags=["robots"], responses=responses(InvalidRequestError))


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a URDF",
    responses=responses(InvalidDataError, InvalidRequestError, TooLargeError, UnsupportedMediaTypeError),
    openapi_extra=UPLOAD_BODY,
)
async def upload(
    request: Request,
    response: Response,
    service: ServiceDep,
    name: Annotated[str | None, Query(max_length=200, description="A name for people; the URDF's by default")] = None,
) -> Robot:
    """Check a URDF and store it, or say what is wrong with it. No file that it names is opened."""
    robot = await to_thread.run_sync(store.add, service.database, await _receive(request), name)
    response.headers["Location"] = f"/v1/robots/{robot.id}"
    return robot


@router.get("", summary="List uploaded robots, newest first")
def list_robots(service: ServiceDep, page: PageQuery) -> RobotPage:
    """One page of uploaded robots with their joints."""
    return store.page(service.database, page)


@router.get("/profiles", summary="List the robots known by name")
def profiles() -> ProfileList:
    """Names that a training job may give as its robot without an upload."""
    return ProfileList(items=list(installed_profiles()))


@router.get("/{robot}", summary="One uploaded robot", responses=responses(NotFoundError))
def show(service: ServiceDep, robot: str) -> Robot:
    """Name, joints and hash of an uploaded URDF."""
    return store.show(service.database, robot)


@router.delete(
    "/{robot}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete an uploaded robot",
    responses=responses(NotFoundError, ConflictError),
)
def delete(service: ServiceDep, robot: str) -> None:
    """Delete an uploaded URDF. Models trained with it keep their copy."""
    store.delete(service.database, robot)


async def _receive(request: Request) -> bytes:
    """The URDF of a body, whose size is limited before it gets here."""
    media_type = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        async with request.form(max_files=1, max_fields=8) as form:
            part = form.get("file")
            if not isinstance(part, UploadFile):
                raise invalid_request("file", "missing", "a file in the form field `file`")
            if Path(part.filename or "").suffix.lower() not in SUFFIXES:
                raise _unsupported("file name", Path(part.filename or "").name, f"the ending {' or '.join(SUFFIXES)}")
            return await part.read()
    if media_type not in MEDIA_TYPES:
        raise _unsupported("content-type", media_type, f"{', '.join(MEDIA_TYPES)} or multipart/form-data")
    return await request.body()


def _unsupported(field: str, value: str, expected: str) -> UnsupportedMediaTypeError:
    return UnsupportedMediaTypeError(f"{field} is {value!r}, expected {expected}", [problem(field, value, expected)])
