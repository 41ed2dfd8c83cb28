"""Routes of the Open Inference Protocol."""

from __future__ import annotations

from enum import Enum

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from service import __version__
from service.models.loaded import LoadedModels
from service.oip import answer, versions, wire
from service.oip.openapi import MODEL, VERSION, failures, infer_answer, infer_body
from service.oip.schema import BINARY, ModelMetadata, ModelReady, ServerLive, ServerMetadata, ServerReady
from service.web import health
from service.web.observability.readiness import ReadinessDep
from service.web.route import Reply, Route, hot_route

SMALL = 16 * 1024
"""Bytes of a body that is decoded on the event loop: one query of the largest robot fits many times."""

_ONE, _VERSIONED = {"parameters": [MODEL]}, {"parameters": [MODEL, VERSION]}
_TAGS: list[str | Enum] = ["open inference protocol"]

router = APIRouter(prefix="/v2", tags=_TAGS, route_class=Route)
hot = APIRouter(prefix="/v2", tags=_TAGS)
"""The routes of inference, to be tried before all others: FastAPI tries one route after the other, 2 µs each."""


@router.get("", summary="What serves")
async def server_metadata() -> ServerMetadata:
    """Name, version, and the extensions of the protocol that are supported."""
    return ServerMetadata(name="lipserve", version=__version__, extensions=[BINARY])


@router.get("/health/live", summary="Is the server alive?")
async def live() -> ServerLive:
    """Answer while the event loop turns."""
    return ServerLive()


@router.get("/health/ready", summary="Can the server answer?", responses=failures(503))
def ready(readiness: ReadinessDep) -> ServerReady:
    """Answer once the models are loaded and while the database answers."""
    health.ready(readiness)
    return ServerReady()


@router.get(
    "/models/{model}/versions/{version}",
    summary="The tensors of a version",
    responses=failures(404),
    response_model_exclude_none=True,
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}",
    summary="The tensors of a model",
    responses=failures(404),
    response_model_exclude_none=True,
    openapi_extra=_ONE,
)
async def model_metadata(request: Request) -> ModelMetadata:
    """Inputs that a request brings, outputs that it may ask for, and the versions there are."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await versions.find(loaded, turns, where["model"], where.get("version"))
    return await to_thread.run_sync(versions.metadata, loaded, served)


@router.get(
    "/models/{model}/versions/{version}/ready",
    summary="Can a version answer?",
    responses=failures(404, 503),
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}/ready",
    summary="Can a model answer?",
    responses=failures(404, 503),
    openapi_extra=_ONE,
)
async def model_ready(request: Request) -> ModelReady:
    """Answer once the version is in memory; it is loaded if it is not."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await versions.ready(loaded, turns, where["model"], where.get("version"))
    return ModelReady(name=served.name)


async def _answer(scope: Scope, body: bytes) -> Reply:
    """Answer any request, a wrong one with the error that it raises: one query here, all else in a thread."""
    loaded: LoadedModels = scope["app"].state.loaded
    limiter, settings = scope["app"].state.turns.predictions, loaded.storage.settings
    headers, where = scope["headers"], scope["path_params"]
    served = await versions.find(loaded, limiter, where["model"], where.get("version"))
    if len(body) > SMALL:
        return await to_thread.run_sync(answer.infer, served, body, headers, settings, limiter=limiter)
    message = wire.decode(body, headers)
    query = answer.question(served, message, body, settings)
    if query.quick:
        return answer.respond(served, message.request, query)
    return await to_thread.run_sync(answer.respond, served, message.request, query, limiter=limiter)


async def infer(request: Request) -> Response:
    """Answer one query, [n], or a batch, [N, n], in JSON or binary. Only what `outputs` names is computed: `tau` and
    `tau_std` where it names nothing. Nothing is clipped. `noise_std` [n] is the measurement's own deviation; an
    interval that shall hold measurements needs both.
    """
    reply = await _answer(request.scope, await request.body())  # for the documentation: all has been answered before
    return reply.response()


for _path, _summary, _parameters in (
    ("/models/{model}/infer", "Torque at a motion", _ONE),
    ("/models/{model}/versions/{version}/infer", "Torque at a motion, by a version", _VERSIONED),
):
    hot.add_api_route(
        _path,
        infer,
        methods=["POST"],
        summary=_summary,
        response_class=Response,
        responses={200: infer_answer(), **failures(400, 404, 413, 415)},
        openapi_extra=infer_body(_parameters),
        route_class_override=hot_route(_answer),
    )
