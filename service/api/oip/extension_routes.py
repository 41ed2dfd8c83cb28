"""Routes of Triton's extensions: repository index, model configuration and statistics.

They are for Triton's tools and not part of the OpenAPI document.
"""

from __future__ import annotations

from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Body, Request
from pydantic import BaseModel

from service.api.access.scopes import READ, needs
from service.api.oip import dataplane, extensions
from service.api.route import Route

router = APIRouter(prefix="/v2", route_class=Route, include_in_schema=False)


class IndexRequest(BaseModel):
    """Filter of the repository index. ready: only versions that can answer."""

    ready: bool = False


@router.post("/repository/index")
@needs(READ)
def index(request: Request, body: Annotated[IndexRequest | None, Body()] = None) -> list[dict[str, Any]]:
    """Return all versions of all models with their state."""
    return extensions.index(request.app.state.loaded, body is not None and body.ready)


@router.post("/repository/models/{model}/load")
@router.post("/repository/models/{model}/unload")
@needs(READ)
def load(model: str) -> None:
    """Reject the request and explain what to do."""
    raise extensions.refuse_loading(model)


@router.get("/models/{model}/versions/{version}/config")
@router.get("/models/{model}/config")
@needs(READ)
async def config(request: Request) -> dict[str, Any]:
    """Return the configuration of a version."""
    state, where = request.app.state, request.path_params
    served = await dataplane.find(state.loaded, state.turns.predictions, where["model"], where.get("version"))
    return extensions.config(served)


@router.get("/models/stats")
@router.get("/models/{model}/stats")
@needs(READ)
async def statistics(request: Request) -> dict[str, Any]:
    """Return the statistics of all versions of a model, or of all models."""
    state, model = request.app.state, request.path_params.get("model")
    found = await to_thread.run_sync(extensions.statistics, state.statistics, state.loaded, model)
    return {"model_stats": found}


@router.get("/models/{model}/versions/{version}/stats")
@needs(READ)
async def version_statistics(request: Request) -> dict[str, Any]:
    """Return the statistics of a version."""
    state, where = request.app.state, request.path_params
    served = await dataplane.find(state.loaded, state.turns.predictions, where["model"], where["version"])
    return {"model_stats": [state.statistics.show(served.name, served.version)]}
