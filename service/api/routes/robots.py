"""Routes of robots."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response, status

from service.api.access.scopes import READ, TRAIN, needs
from service.api.dependencies import PageQuery, StorageDep
from service.api.errors import responses
from service.api.limits.upload import Kinds, receive
from service.api.route import Route
from service.contract.robots import UPLOAD_BODY, ProfileList, Robot, RobotPage, RobotProfile
from service.foundation.errors import (
    ConflictError,
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    NotInstalledError,
    TooLargeError,
    UnsupportedMediaTypeError,
)
from service.foundation.fields import NameForPeople
from service.robots import store

router = APIRouter(prefix="/v1/robots", tags=["robots"], responses=responses(InvalidRequestError), route_class=Route)


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a URDF",
    responses=responses(
        InvalidDataError, InvalidRequestError, TooLargeError, UnsupportedMediaTypeError, NotInstalledError
    ),
    openapi_extra=UPLOAD_BODY,
)
@needs(TRAIN)
async def upload(
    request: Request,
    response: Response,
    storage: StorageDep,
    name: Annotated[NameForPeople | None, Query(description="Display name. Default: the name in the URDF")] = None,
    scale: Annotated[
        str | None,
        Query(max_length=100, description="Factors to SI units: `length=0.001,inertia=1e-9` for mm and g·mm²"),
    ] = None,
    xacro: Annotated[
        str | None, Query(max_length=1000, description="Arguments of a xacro: `ur_type=ur5e,name=ur`")
    ] = None,
) -> Robot:
    """Check a URDF and store it as a robot; SDF and MJCF are converted, xacro is expanded. Meshes are not opened.

    A wrong URDF is rejected: `detail` names what is wrong.
    """
    kinds = Kinds(
        dict.fromkeys(("application/xml", "text/xml", "application/zip"), "urdf"),
        dict.fromkeys((".urdf", ".sdf", ".xml", ".xacro", ".zip"), "urdf"),
    )
    _, content = await receive(request, kinds)
    await to_thread.run_sync(storage.disk.reserve, len(content))
    robot = await to_thread.run_sync(store.add, storage.database, content, name, scale, xacro, storage.settings)
    response.headers["Location"] = f"/v1/robots/{robot.id}"
    return robot


@router.get("", summary="List uploaded robots, newest first")
@needs(READ)
def list_robots(storage: StorageDep, page: PageQuery) -> RobotPage:
    """Return one page of uploaded robots with their joints."""
    return store.page(storage.database, page)


@router.get("/profiles", summary="List robot profiles")
@needs(READ)
def profiles() -> ProfileList:
    """Return the joints, the limits and the meaning of the effort column of every built-in robot.

    Uploads may name any of them as their `robot`. Training jobs may name those that have a URDF.
    """
    return ProfileList(items=store.list_profiles())


@router.get("/profiles/{name}", summary="Retrieve a robot profile", responses=responses(NotFoundError))
@needs(READ)
def profile(storage: StorageDep, name: str) -> RobotProfile:
    """Return joints, limits and the meaning of the effort column of one robot.

    `name` is a name from `GET /v1/robots/profiles` or the id of an uploaded URDF.
    """
    return store.show_profile(storage.database, name)


@router.get("/{robot}", summary="Retrieve an uploaded robot", responses=responses(NotFoundError))
@needs(READ)
def show(storage: StorageDep, robot: str) -> Robot:
    """Return name, joints and hash of an uploaded URDF."""
    return store.show(storage.database, robot)


@router.delete(
    "/{robot}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete an uploaded robot",
    responses=responses(NotFoundError, ConflictError),
)
@needs(TRAIN)
def delete(storage: StorageDep, robot: str) -> None:
    """Delete an uploaded URDF. Models trained with it keep their own copy."""
    store.delete(storage.database, robot)
