"""Routes that take a version elsewhere: export and import, and its arm as a URDF."""

from __future__ import annotations

from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response, status
from fastapi.responses import StreamingResponse

from service.foundation.errors import (
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnreadableVersionError,
    UnsupportedMediaTypeError,
    responses,
)
from service.models import archive_import, urdf
from service.models.archive import MEDIA_TYPE
from service.models.export import export
from service.models.loaded import LoadedModelsDep
from service.models.schema import AliasName, ModelName, Version, VersionNumber
from service.web.limits.requests import ArchivesDep
from service.web.limits.upload import Kinds, receive_to
from service.web.route import Route

KINDS = Kinds({MEDIA_TYPE: "tar"}, {".tar": "tar"})
_BINARY = {"schema": {"type": "string", "format": "binary"}}
_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "An archive as an export writes it.",
        "content": {
            MEDIA_TYPE: _BINARY,
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary", "description": "A .tar file"}},
                }
            },
        },
    }
}

WhichVersion = Annotated[VersionNumber | None, Query(description="The version that serves by default")]
WhichAlias = Annotated[AliasName | None, Query(description="An alias, instead of a version's number")]

router = APIRouter(prefix="/v1/models", tags=["models"], responses=responses(InvalidRequestError), route_class=Route)


@router.post(
    "/import",
    status_code=status.HTTP_201_CREATED,
    summary="Import a version",
    responses=responses(InvalidDataError, InvalidRequestError, TooLargeError, UnsupportedMediaTypeError),
    openapi_extra=_BODY,
)
async def import_version(
    request: Request,
    response: Response,
    loaded: LoadedModelsDep,
    turns: ArchivesDep,
    name: Annotated[ModelName | None, Query(description="Name of the model; that of the archive by default")] = None,
) -> Version:
    """Check an archive and make a new version of it, which answers where the model had none."""
    path = loaded.files.upload()
    try:
        await receive_to(request, path, KINDS, loaded.storage.disk)
        version = await to_thread.run_sync(archive_import.add, loaded, path, name, limiter=turns)
    finally:
        path.unlink(missing_ok=True)
    response.headers["Location"] = f"/v1/models/{version.model}/versions/{version.version}"
    return version


@router.get(
    "/{model}/export",
    summary="Export a version",
    response_class=StreamingResponse,
    responses={
        **responses(NotFoundError, UnreadableVersionError),
        200: {"description": "A tar file", "content": {MEDIA_TYPE: _BINARY}},
    },
)
async def export_version(
    loaded: LoadedModelsDep,
    turns: ArchivesDep,
    model: str,
    version: WhichVersion = None,
    alias: WhichAlias = None,
    learnt: Annotated[bool, Query(description="With what it has learnt online; false: as it was trained")] = True,
) -> StreamingResponse:
    """One archive with all that another service needs to answer alike; `export.json` in it says what it holds."""
    found = await to_thread.run_sync(export, loaded, model, version, alias, learnt, limiter=turns)
    headers = {"Content-Length": str(found.size), "Content-Disposition": f'attachment; filename="{found.name}"'}
    return StreamingResponse(found.pieces, media_type=MEDIA_TYPE, headers=headers)


@router.get(
    "/{model}/urdf",
    summary="The arm that a version has learnt, as a URDF",
    response_class=Response,
    responses={
        **responses(NotFoundError, InvalidRequestError),
        200: {
            "description": "A URDF",
            "content": {urdf.MEDIA_TYPE: {"schema": {"type": "string"}, "example": urdf.EXAMPLE}},
        },
    },
)
def version_urdf(
    loaded: LoadedModelsDep, model: str, version: WhichVersion = None, alias: WhichAlias = None
) -> Response:
    """Links, joints, physically possible masses and friction, as they were trained, for simulators and planners.

    Of estimators with rigid bodies whose geometry is known; the others answer 422. Comments in the text say what a URDF
    has no place for, and what torque does not tell.
    """
    name, text = urdf.write(loaded, model, version, alias)
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(text, media_type=urdf.MEDIA_TYPE, headers=headers)
