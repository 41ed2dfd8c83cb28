"""Routes of models and versions, and of what takes a version elsewhere: export and import, and its arm as a URDF."""

from __future__ import annotations

from typing import Annotated, Literal

from anyio import to_thread
from fastapi import APIRouter, Path, Query, Request, Response, status
from fastapi.responses import StreamingResponse

from service.api.access.scopes import ADMIN, READ, needs
from service.api.dependencies import ArchivesDep, LoadedModelsDep, PageQuery
from service.api.errors import responses
from service.api.limits.upload import Kinds, receive_to
from service.api.route import Route
from service.contract import models as schema
from service.contract.states import PromotionOption
from service.foundation.errors import (
    ConflictError,
    InvalidDataError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    UnreadableVersionError,
    UnsupportedMediaTypeError,
)
from service.foundation.fields import BINARY, upload_body
from service.models import aliases, archive, archive_import, deletion, registry

_BINARY = {"schema": BINARY}
_BODY = upload_body("An archive as an export writes it.", {archive.MEDIA_TYPE: _BINARY}, "A .tar file")

WhichVersion = Annotated[schema.VersionNumber | None, Query(description="The version that serves by default")]
WhichAlias = Annotated[schema.AliasName | None, Query(description="An alias, instead of a version's number")]
AliasPath = Annotated[schema.AliasName, Path(description="`serving`, or a name of your own")]

router = APIRouter(prefix="/v1/models", tags=["models"], responses=responses(InvalidRequestError), route_class=Route)


@router.post(
    "/import",
    status_code=status.HTTP_201_CREATED,
    summary="Import a version",
    responses=responses(InvalidDataError, InvalidRequestError, TooLargeError, UnsupportedMediaTypeError),
    openapi_extra=_BODY,
)
@needs(ADMIN)
async def import_version(
    request: Request,
    response: Response,
    loaded: LoadedModelsDep,
    turns: ArchivesDep,
    name: Annotated[
        schema.ModelName | None, Query(description="Name of the model; that of the archive by default")
    ] = None,
    promotion: Annotated[
        PromotionOption | None,
        Query(
            description="Whether it answers: `ask`, if the model had no version and the figures that come with it say "
            "that it does well on what its training held out; `always`, in any case. LIPSERVE_PROMOTION by default"
        ),
    ] = None,
) -> schema.Version:
    """Check an archive and make a new version of it."""
    path = loaded.files.upload()
    try:
        await receive_to(request, path, Kinds({archive.MEDIA_TYPE: "tar"}, {".tar": "tar"}), loaded.storage.disk)
        version = await to_thread.run_sync(archive_import.add, loaded, path, name, promotion, limiter=turns)
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
        200: {"description": "A tar file", "content": {archive.MEDIA_TYPE: _BINARY}},
    },
)
@needs(READ)
async def export_version(
    loaded: LoadedModelsDep,
    turns: ArchivesDep,
    model: str,
    version: WhichVersion = None,
    alias: WhichAlias = None,
    learnt: Annotated[bool, Query(description="With what it has learnt online; false: as it was trained")] = True,
    format: Annotated[  # noqa: A002 - the field's own name
        Literal["archive", "c"], Query(description="`c`: C99 for control loops, where rigid bodies are known; else 422")
    ] = "archive",
) -> StreamingResponse:
    """One archive with all that another service needs to answer alike; `export.json` in it says what it holds.

    With `format=c` an archive of `lipserve_model.c` and `lipserve_model.h`: torque and its standard deviation in C99,
    without dependencies or allocation. The header says how to use them.
    """
    as_c = format == "c"
    archived = await to_thread.run_sync(archive.export, loaded, model, version, alias, learnt, as_c, limiter=turns)
    headers = {"Content-Length": str(archived.size), "Content-Disposition": f'attachment; filename="{archived.name}"'}
    return StreamingResponse(archived.pieces, media_type=archive.MEDIA_TYPE, headers=headers)


@router.get(
    "/{model}/urdf",
    summary="The arm that a version has learnt, as a URDF",
    response_class=Response,
    responses={
        **responses(NotFoundError, InvalidRequestError),
        200: {
            "description": "A URDF",
            "content": {archive.URDF_MEDIA_TYPE: {"schema": {"type": "string"}, "example": archive.URDF_EXAMPLE}},
        },
    },
)
@needs(READ)
def version_urdf(
    loaded: LoadedModelsDep, model: str, version: WhichVersion = None, alias: WhichAlias = None
) -> Response:
    """Links, joints, physically possible masses and friction, as they were trained, for simulators and planners.

    Of estimators with rigid bodies whose geometry is known; the others answer 422. Comments in the text say what a URDF
    has no place for, and what torque does not tell.
    """
    name, text = archive.write_urdf(loaded, model, version, alias)
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(text, media_type=archive.URDF_MEDIA_TYPE, headers=headers)


@router.get("", summary="List models, newest first")
@needs(READ)
def list_models(loaded: LoadedModelsDep, page: PageQuery) -> schema.ModelPage:
    """One page of models with their versions."""
    listed = registry.page(loaded.database, page)
    loaded.announce([item.name for item in listed.items])
    return listed


@router.get("/{model}", summary="One model and its versions", responses=responses(NotFoundError))
@needs(READ)
def show(loaded: LoadedModelsDep, model: str) -> schema.Model:
    """Which versions there are and which one answers."""
    record = registry.show(loaded.database, model)
    loaded.announce([record.name])
    return record


@router.get("/{model}/versions/{version}", summary="One version", responses=responses(NotFoundError))
@needs(READ)
def show_version(loaded: LoadedModelsDep, model: str, version: schema.VersionNumber) -> schema.Version:
    """Joints, noise, training range, options, what the fit reported, and the data it came from."""
    return registry.show_version(loaded.database, model, version)


@router.delete(
    "/{model}/versions/{version}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a version",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def delete_version(loaded: LoadedModelsDep, model: str, version: schema.VersionNumber) -> None:
    """Delete a version that nothing needs: no alias, not the service and no job. Its number is not given
    again."""
    deletion.delete_version(loaded, model, version)


@router.delete(
    "/{model}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a model",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def delete_model(loaded: LoadedModelsDep, model: str) -> None:
    """Delete a model with its versions, aliases and all that it has observed and learnt. Jobs and data sets stay."""
    deletion.delete_model(loaded, model)


@router.get("/{model}/aliases", summary="List the aliases of a model", responses=responses(NotFoundError))
@needs(READ)
def list_aliases(loaded: LoadedModelsDep, model: str) -> schema.AliasList:
    """Where each points, since when, and where it pointed before. `serving` is the version that answers by default."""
    return aliases.page(loaded, model)


@router.put(
    "/{model}/aliases/{alias}",
    summary="Point an alias to a version",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
@needs(ADMIN)
def put_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath, request: schema.AliasRequest) -> schema.Alias:
    """Make or move an alias. The version is loaded first: queries follow in one step, and none fails or waits."""
    return aliases.put(loaded, model, alias, request)


@router.delete(
    "/{model}/aliases/{alias}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Remove an alias",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def remove_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> None:
    """Remove an alias; the version stays, and a rollback brings the alias back. `serving` cannot be removed."""
    aliases.remove(loaded, model, alias)


@router.post(
    "/{model}/aliases/{alias}/rollback",
    summary="Point an alias to where it pointed before",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
@needs(ADMIN)
def rollback_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> schema.Alias:
    """Take back the last move, the next time the one before it, and so on."""
    return aliases.rollback(loaded, model, alias)
