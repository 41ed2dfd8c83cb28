"""Routes of models and versions."""

from __future__ import annotations

from fastapi import APIRouter

from service.context import ServiceDep
from service.errors import InvalidRequestError, NotFoundError, responses
from service.models import registry
from service.models.schema import Model, ModelPage, Version, VersionNumber
from service.pages import PageQuery

router = APIRouter(prefix="/v1/models", tags=["models"], responses=responses(InvalidRequestError))


@router.get("", summary="List models, newest first")
def list_models(service: ServiceDep, page: PageQuery) -> ModelPage:
    """One page of models with their versions."""
    found = registry.page(service.database, page)
    service.loaded.announce([item.name for item in found.items])
    return found


@router.get("/{model}", summary="One model and its versions", responses=responses(NotFoundError))
def show(service: ServiceDep, model: str) -> Model:
    """Which versions there are and which one answers."""
    found = registry.show(service.database, model)
    service.loaded.announce([found.name])
    return found


@router.get("/{model}/versions/{version}", summary="One version", responses=responses(NotFoundError))
def show_version(service: ServiceDep, model: str, version: VersionNumber) -> Version:
    """Joints, noise, training range, options, what the fit reported, and the data it came from."""
    return registry.show_version(service.database, model, version)
