"""Routes of models and versions."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, status

from service.foundation.errors import (
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    UnreadableVersionError,
    responses,
)
from service.models import aliases, deletion, registry
from service.models.alias_schema import Alias, AliasList, AliasRequest
from service.models.loaded import LoadedModelsDep
from service.models.schema import AliasName, Model, ModelPage, Version, VersionNumber
from service.web.pagination import PageQuery
from service.web.route import Route

router = APIRouter(prefix="/v1/models", tags=["models"], responses=responses(InvalidRequestError), route_class=Route)
AliasPath = Annotated[AliasName, Path(description="`serving`, or a name of your own")]


@router.get("", summary="List models, newest first")
def list_models(loaded: LoadedModelsDep, page: PageQuery) -> ModelPage:
    """One page of models with their versions."""
    found = registry.page(loaded.database, page)
    loaded.announce([item.name for item in found.items])
    return found


@router.get("/{model}", summary="One model and its versions", responses=responses(NotFoundError))
def show(loaded: LoadedModelsDep, model: str) -> Model:
    """Which versions there are and which one answers."""
    found = registry.show(loaded.database, model)
    loaded.announce([found.name])
    return found


@router.get("/{model}/versions/{version}", summary="One version", responses=responses(NotFoundError))
def show_version(loaded: LoadedModelsDep, model: str, version: VersionNumber) -> Version:
    """Joints, noise, training range, options, what the fit reported, and the data it came from."""
    return registry.show_version(loaded.database, model, version)


@router.delete(
    "/{model}/versions/{version}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a version",
    responses=responses(NotFoundError, ConflictError),
)
def delete_version(loaded: LoadedModelsDep, model: str, version: VersionNumber) -> None:
    """Delete a version that nothing needs: no alias, not the service, no contest and no job. Its number is not given
    again."""
    deletion.delete_version(loaded, model, version)


@router.delete(
    "/{model}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a model",
    responses=responses(NotFoundError, ConflictError),
)
def delete_model(loaded: LoadedModelsDep, model: str) -> None:
    """Delete a model with its versions, aliases and all that it has observed and learnt. Jobs and data sets stay."""
    deletion.delete_model(loaded, model)


@router.get("/{model}/aliases", summary="List the aliases of a model", responses=responses(NotFoundError))
def list_aliases(loaded: LoadedModelsDep, model: str) -> AliasList:
    """Where each points, since when, and where it pointed before. `serving` is the version that answers by default."""
    return aliases.page(loaded, model)


@router.put(
    "/{model}/aliases/{alias}",
    summary="Point an alias to a version",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
def put_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath, request: AliasRequest) -> Alias:
    """Make or move an alias. The version is loaded first: queries follow in one step, and none fails or waits."""
    return aliases.put(loaded, model, alias, request)


@router.delete(
    "/{model}/aliases/{alias}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Remove an alias",
    responses=responses(NotFoundError, ConflictError),
)
def remove_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> None:
    """Remove an alias; the version stays, and a rollback brings the alias back. `serving` cannot be removed."""
    aliases.remove(loaded, model, alias)


@router.post(
    "/{model}/aliases/{alias}/rollback",
    summary="Point an alias to where it pointed before",
    responses=responses(NotFoundError, ConflictError, UnreadableVersionError),
)
def rollback_alias(loaded: LoadedModelsDep, model: str, alias: AliasPath) -> Alias:
    """Take back the last move, the next time the one before it, and so on."""
    return aliases.rollback(loaded, model, alias)
