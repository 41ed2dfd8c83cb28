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
    name: Annotated[NameForPeople | None, Query(description="A name for people; the URDF's by default")] = None,
) -> Robot:
    """Check a URDF and store it, or say what is wrong with it. No file that it names is opened."""
    kinds = Kinds({"application/xml": "urdf", "text/xml": "urdf"}, {".urdf": "urdf", ".xml": "urdf"})
    _, content = await receive(request, kinds)
    await to_thread.run_sync(storage.disk.reserve, len(content))
    robot = await to_thread.run_sync(store.add, storage.database, content, name, storage.settings)
    response.headers["Location"] = f"/v1/robots/{robot.id}"
    return robot


@router.get("", summary="List uploaded robots, newest first")
@needs(READ)
def list_robots(storage: StorageDep, page: PageQuery) -> RobotPage:
    """One page of uploaded robots with their joints."""
    return store.page(storage.database, page)


@router.get("/profiles", summary="List the robots known by name")
@needs(READ)
def profiles() -> ProfileList:
    """Joints, limits and the meaning of effort of each. Uploads may name any as their robot, jobs those with a URDF."""
    return ProfileList(items=store.list_profiles())


@router.get("/profiles/{name}", summary="One robot known by name, or uploaded", responses=responses(NotFoundError))
@needs(READ)
def profile(storage: StorageDep, name: str) -> RobotProfile:
    """Joints, limits and the meaning of effort of a robot, by its name or the id of an uploaded URDF."""
    return store.show_profile(storage.database, name)


@router.get("/{robot}", summary="One uploaded robot", responses=responses(NotFoundError))
@needs(READ)
def show(storage: StorageDep, robot: str) -> Robot:
    """Name, joints and hash of an uploaded URDF."""
    return store.show(storage.database, robot)


@router.delete(
    "/{robot}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete an uploaded robot",
    responses=responses(NotFoundError, ConflictError),
)
@needs(TRAIN)
def delete(storage: StorageDep, robot: str) -> None:
    """Delete an uploaded URDF. Models trained with it keep their copy."""
    store.delete(storage.database, robot)
