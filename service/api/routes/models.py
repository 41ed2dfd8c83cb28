"""Routes of models, versions and aliases, and of export and import."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Path, Query, Request, Response, status
from fastapi.responses import StreamingResponse

from lipcore.vocabulary import ExportFormat
from service.api.access.scopes import ADMIN, READ, needs
from service.api.dependencies import ArchivesDep, LoadedModelsDep, PageQuery
from service.api.errors import responses
from service.api.limits.upload import Kinds, receive_to
from service.api.route import Route
from service.contract import models as schema
from service.contract.states import PromotionOption
from service.contract.verdict import Thresholds
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
from service.models import aliases, archive, archive_import, deletion, notes, registry

_BINARY = {"schema": BINARY}
_BODY = upload_body("An archive written by an export.", {archive.MEDIA_TYPE: _BINARY}, "A .tar file")

WhichVersion = Annotated[
    schema.VersionNumber | None, Query(description="A version's number. Default: the serving version")
]
WhichAlias = Annotated[schema.AliasName | None, Query(description="An alias instead of a version's number")]
AliasPath = Annotated[schema.AliasName, Path(description="`serving` or a name of your choice")]

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
        schema.ModelName | None, Query(description="Name of the model. Default: the name in the archive")
    ] = None,
    promotion: Annotated[
        PromotionOption | None,
        Query(
            description="When the version starts serving. `ask`: if the model has no other version and the archive's "
            "figures on held-out data are good, else it becomes a candidate. `always`: at once. Default: "
            "LIPSERVE_PROMOTION"
        ),
    ] = None,
) -> schema.Version:
    """Check an archive and create a new version from it."""
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
        200: {
            "description": "A tar file, XML for `urdf` and `mjcf`, or a binary file for `torch`",
            "content": {
                archive.MEDIA_TYPE: _BINARY,
                "application/xml": {"schema": {"type": "string"}},
                "application/octet-stream": _BINARY,
            },
        },
    },
)
@needs(READ)
async def export_version(
    loaded: LoadedModelsDep,
    turns: ArchivesDep,
    model: str,
    version: WhichVersion = None,
    alias: WhichAlias = None,
    learnt: Annotated[bool, Query(description="Include what was learnt online; false: as trained")] = True,
    format: Annotated[  # noqa: A002 - the field's own name
        ExportFormat, Query(description="`urdf`, `mjcf`, `c`: rigid-body estimators only, else 422")
    ] = "archive",
) -> StreamingResponse:
    """Return a version as a file. It contains its origin: name, version, revision and hash.

    - `archive`: a tar that another service can import and serve. `export.json` in it lists the contents.
    - `urdf`, `mjcf`: links, joints, friction, rotors and physically possible masses, for simulators and planners.
      Comments state the largest torque error of each joint, and parameters that torque cannot identify.
    - `c`: a tar of `lipserve_model.c` and `lipserve_model.h`, C99 code for control loops that computes torque and its
      standard deviation without dependencies or allocation. The header explains how to use it.
    - `onnx`: a tar of a Triton model repository with a float64 and a float32 model. onnxruntime loads them, too.
    - `torch`: an archive of `torch.export`. `jax`: a tar of functions of `jax.export`.

    The last three compute torque and standard deviation of a batch of states, without LIPServe. All but the archive
    have a self-test of 100 states.
    """
    made = await to_thread.run_sync(archive.export, loaded, model, version, alias, learnt, format, limiter=turns)
    headers = {"Content-Length": str(made.size), "Content-Disposition": f'attachment; filename="{made.name}"'}
    return StreamingResponse(made.pieces, media_type=made.media_type, headers=headers)


@router.get("", summary="List models, newest first")
@needs(READ)
def list_models(loaded: LoadedModelsDep, page: PageQuery) -> schema.ModelPage:
    """Return one page of models with their versions."""
    listed = registry.page(loaded.database, page)
    loaded.announce([item.name for item in listed.items])
    return listed


@router.get("/{model}", summary="Retrieve a model and its versions", responses=responses(NotFoundError))
@needs(READ)
def show(loaded: LoadedModelsDep, model: str) -> schema.Model:
    """Return a model with all its versions and the serving version."""
    record = registry.show(loaded.database, model)
    loaded.announce([record.name])
    return record


@router.put(
    "/{model}/thresholds", summary="Set the thresholds of a model's verdicts", responses=responses(NotFoundError)
)
@needs(ADMIN)
def set_thresholds(loaded: LoadedModelsDep, model: str, thresholds: Thresholds) -> schema.Model:
    """Replace all thresholds. Omitted ones get their defaults. Verdicts change at once; what serves does not."""
    return registry.set_thresholds(loaded.database, model, thresholds)


@router.get("/{model}/versions/{version}", summary="Retrieve a version", responses=responses(NotFoundError))
@needs(READ)
def show_version(loaded: LoadedModelsDep, model: str, version: schema.VersionNumber) -> schema.Version:
    """Return a version: joints, noise, training range, options, report of the fit, and training data."""
    return registry.show_version(loaded.database, model, version)


@router.patch(
    "/{model}/versions/{version}", summary="Set the note and the tags of a version", responses=responses(NotFoundError)
)
@needs(ADMIN)
def annotate_version(
    loaded: LoadedModelsDep, model: str, version: schema.VersionNumber, annotation: schema.Annotation
) -> schema.Version:
    """Change the note, the tags or both. An omitted field stays; null or an empty value removes it."""
    return notes.annotate(loaded.database, model, version, annotation)


@router.delete(
    "/{model}/versions/{version}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a version",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def delete_version(loaded: LoadedModelsDep, model: str, version: schema.VersionNumber) -> None:
    """Delete a version. Its number is not reused.

    The request fails with 409 if an alias, the service or a job still needs the version.
    """
    deletion.delete_version(loaded, model, version)


@router.delete(
    "/{model}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a model",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def delete_model(loaded: LoadedModelsDep, model: str) -> None:
    """Delete a model with its versions, aliases, observations and everything learnt from them.

    Training jobs and data sets stay.
    """
    deletion.delete_model(loaded, model)


@router.get("/{model}/aliases", summary="List the aliases of a model", responses=responses(NotFoundError))
@needs(READ)
def list_aliases(loaded: LoadedModelsDep, model: str) -> schema.AliasList:
    """Return every alias with its version, the time of its last move and its earlier versions.

    `serving` names the version that answers by default.
    """
    return aliases.page(loaded, model)


@router.put(
    "/{model}/aliases/{alias}",
    summary="Point an alias to a version",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
@needs(ADMIN)
def put_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath, request: schema.AliasRequest) -> schema.Alias:
    """Create or move an alias.

    The version is loaded before the alias moves, so that no query fails or waits.
    """
    return aliases.put(loaded, model, alias, request)


@router.delete(
    "/{model}/aliases/{alias}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Remove an alias",
    responses=responses(NotFoundError, ConflictError),
)
@needs(ADMIN)
def remove_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> None:
    """Remove an alias. The version stays, and a rollback restores the alias. `serving` cannot be removed."""
    aliases.remove(loaded, model, alias)


@router.post(
    "/{model}/aliases/{alias}/rollback",
    summary="Undo the last move of an alias",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
@needs(ADMIN)
def rollback_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> schema.Alias:
    """Point an alias to its previous version. Every further call undoes one earlier move."""
    return aliases.rollback(loaded, model, alias)
