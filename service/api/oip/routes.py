"""Routes of the Open Inference Protocol over HTTP."""

from __future__ import annotations

from enum import Enum
from functools import partial

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from service import __version__
from service.api.access.scopes import PREDICT, READ, needs
from service.api.dependencies import ReadinessDep
from service.api.oip import dataplane, schema, wire
from service.api.route import Reply, Route, hot_route
from service.api.routes import health
from service.models.loaded import LoadedModels

_ONE, _VERSIONED = {"parameters": [schema.MODEL]}, {"parameters": [schema.MODEL, schema.VERSION]}
_TAGS: list[str | Enum] = ["open inference protocol"]

router = APIRouter(prefix="/v2", tags=_TAGS, route_class=Route)
hot = APIRouter(prefix="/v2", tags=_TAGS)
"""The routes of inference, to be tried before all others: FastAPI tries one route after the other, 2 µs each."""


@router.get("", summary="What serves")
@needs(READ)
async def server_metadata() -> schema.ServerMetadata:
    """Name, version, and the extensions of the protocol that are supported."""
    return schema.ServerMetadata(name="lipserve", version=__version__, extensions=[schema.BINARY])


@router.get("/health/live", summary="Is the server alive?")
@needs(None)
async def live() -> schema.ServerLive:
    """Answer while the event loop turns."""
    return schema.ServerLive()


@router.get("/health/ready", summary="Can the server answer?", responses=schema.failures(503))
@needs(None)
def ready(readiness: ReadinessDep) -> schema.ServerReady:
    """Answer once the models are loaded and while the database answers."""
    health.ready(readiness)
    return schema.ServerReady()


@router.get(
    "/models/{model}/versions/{version}",
    summary="The tensors of a version",
    responses=schema.failures(404),
    response_model_exclude_none=True,
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}",
    summary="The tensors of a model",
    responses=schema.failures(404),
    response_model_exclude_none=True,
    openapi_extra=_ONE,
)
@needs(READ)
async def model_metadata(request: Request) -> schema.ModelMetadata:
    """Inputs that a request brings, outputs that it may ask for, and the versions there are."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await dataplane.find(loaded, turns, where["model"], where.get("version"))
    return await to_thread.run_sync(dataplane.metadata, loaded, served)


@router.get(
    "/models/{model}/versions/{version}/ready",
    summary="Can a version answer?",
    responses=schema.failures(404, 503),
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}/ready",
    summary="Can a model answer?",
    responses=schema.failures(404, 503),
    openapi_extra=_ONE,
)
@needs(READ)
async def model_ready(request: Request) -> schema.ModelReady:
    """Answer once the version is in memory; it is loaded if it is not."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await dataplane.ready(loaded, turns, where["model"], where.get("version"))
    return schema.ModelReady(name=served.name)


async def _answer(scope: Scope, body: bytes) -> Reply:
    """Answer any request, a wrong one with the error that it raises."""
    state, where = scope["app"].state, scope["path_params"]
    decode = partial(wire.decode, body, scope["headers"])
    return await dataplane.infer(
        state.loaded, state.turns.predictions, where["model"], where.get("version"), len(body), decode
    )


@needs(PREDICT)
async def infer(request: Request) -> Response:
    """Answer one query, [n], or a batch, [N, n], in JSON or binary. Only what `outputs` names is computed: `tau` and
    `tau_std` where it names nothing. Nothing is clipped. `noise_std` [n] is the measurement's own deviation; an
    interval that shall hold measurements needs both, and `scale` [n], see `PredictResponse`.

    With the input `tau`, as measured: `tau_external` [n], how much of it the model does not explain, `tau_external_std`
    = `scale` · √(`tau_std`² + `noise_std`²), `tau_external_z`, the one over the other; `tau_external_statistic` of the
    arm as one, eᵀ C⁻¹ e, χ² with n degrees of freedom where nothing touches it, and `tau_external_p`. Not a safety
    function.
    """
    reply = await _answer(request.scope, await request.body())  # for the documentation: all has been answered before
    return reply.response()


for _path, _summary, _documented in (
    ("/models/{model}/infer", "Torque at a motion", _ONE),
    ("/models/{model}/versions/{version}/infer", "Torque at a motion, by a version", _VERSIONED),
):
    hot.add_api_route(
        _path,
        infer,
        methods=["POST"],
        summary=_summary,
        response_class=Response,
        responses={200: schema.infer_answer(), **schema.failures(400, 404, 413, 415)},
        openapi_extra=schema.infer_body(_documented),
        route_class_override=hot_route(_answer),
    )
