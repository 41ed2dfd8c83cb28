"""Routes of the Open Inference Protocol over HTTP."""

from __future__ import annotations

from collections.abc import Awaitable
from enum import Enum
from functools import partial

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from service import __version__
from service.api.access.scopes import PREDICT, READ, needs
from service.api.dependencies import ReadinessDep
from service.api.elsewhere import Elsewhere
from service.api.oip import dataplane, schema, wire
from service.api.route import Reply, Route, hot_route
from service.api.routes import health
from service.models.loaded import LoadedModels

_ONE, _VERSIONED = {"parameters": [schema.MODEL]}, {"parameters": [schema.MODEL, schema.VERSION]}
_TAGS: list[str | Enum] = ["open inference protocol"]

router = APIRouter(prefix="/v2", tags=_TAGS, route_class=Route)
hot = APIRouter(prefix="/v2", tags=_TAGS)
"""Inference routes, matched before all others: FastAPI tries routes one by one, 2 µs each."""


@router.get("", summary="Retrieve server metadata")
@needs(READ)
async def server_metadata() -> schema.ServerMetadata:
    """Return name and version of the server, and the supported extensions of the protocol."""
    return schema.ServerMetadata(name="lipserve", version=__version__, extensions=schema.EXTENSIONS)


@router.get("/health/live", summary="Check that the server is alive")
@needs(None)
async def live() -> schema.ServerLive:
    """Answer 200 while the event loop runs."""
    return schema.ServerLive()


@router.get("/health/ready", summary="Check that the server is ready", responses=schema.failures(503))
@needs(None)
def ready(readiness: ReadinessDep) -> schema.ServerReady:
    """Answer 200 if the models are loaded and every part of the service works, else 503."""
    health.ready(readiness)
    return schema.ServerReady()


@router.get(
    "/models/{model}/versions/{version}",
    summary="Retrieve the tensors of a version",
    responses=schema.failures(404),
    response_model_exclude_none=True,
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}",
    summary="Retrieve the tensors of a model",
    responses=schema.failures(404),
    response_model_exclude_none=True,
    openapi_extra=_ONE,
)
@needs(READ)
async def model_metadata(request: Request) -> schema.ModelMetadata:
    """Return the inputs that a request needs, the outputs that it may request, and the versions of the model."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await dataplane.find(loaded, turns, where["model"], where.get("version"))
    return await to_thread.run_sync(dataplane.metadata, loaded, served)


@router.get(
    "/models/{model}/versions/{version}/ready",
    summary="Check that a version is ready",
    responses=schema.failures(404, 503),
    openapi_extra=_VERSIONED,
)
@router.get(
    "/models/{model}/ready",
    summary="Check that a model is ready",
    responses=schema.failures(404, 503),
    openapi_extra=_ONE,
)
@needs(READ)
async def model_ready(request: Request) -> schema.ModelReady:
    """Answer 200 when the version is in memory. If it is not, it is loaded first."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await dataplane.ready(loaded, turns, where["model"], where.get("version"))
    return schema.ModelReady(name=served.name)


async def _answer(scope: Scope, body: bytes) -> Reply | Awaitable[Reply]:
    """Answer any inference request; raise ServiceError for a wrong one."""
    answer = _infer(scope, body)
    return answer if len(body) > dataplane.MAX_INLINE_BYTES else await answer


async def _infer(scope: Scope, body: bytes) -> Reply:
    state, where, headers = scope["app"].state, scope["path_params"], scope["headers"]
    return await dataplane.infer(
        state.loaded,
        state.sequences,
        state.statistics,
        state.turns.predictions,
        Elsewhere(state),
        where["model"],
        where.get("version"),
        body,
        partial(wire.decode, body, headers),
        partial(wire.decode, headers=headers),
    )


async def answer_at_once(scope: Scope, body: bytes) -> Reply | None:
    """Answer a single query without waiting; return None for any other. Raise ServiceError for a wrong one."""
    state, where = scope["app"].state, scope["path_params"]
    decode = partial(wire.decode, body, scope["headers"])
    return dataplane.infer_at_once(
        state.loaded, state.sequences, state.statistics, where["model"], where.get("version"), decode
    )


@needs(PREDICT)
async def infer(request: Request) -> Response:
    """Predict torque and other outputs for one query, [n], or a batch, [N, n], in JSON or binary.

    Only the outputs in `outputs` are computed; by default `tau` and `tau_std`. Inputs and outputs are not clipped.

    Queries with the same `sequence_id` are one motion, in order of arrival. Friction that depends on earlier motion
    follows it. The motion before a new `sequence_id`, `sequence_start` or a pause of 0.25 s is unknown.

    A batch has at most 1000 queries. With binary inputs and outputs, of which each is `tau`, `tau_std`, `tau_mean`,
    `fallback`, `noise_std` or `scale`, it has at most 100 000, if the body is not too large.

    `tau_mean` is the posterior mean, which never falls back. Alone, it is the fastest output of a large batch.

    The 95 % interval of measurements is `tau` ± 1.96 · `scale` · √(`tau_std`² + `noise_std`²), see `PredictResponse`.

    External torque needs the measured torque as input `tau`. It is not a safety function. Its outputs are:

    - `tau_external` [n]: measured minus predicted torque e.
    - `tau_external_std` [n]: `scale` · √(`tau_std`² + `noise_std`²), the standard deviation of e without contact.
    - `tau_external_z` [n]: `tau_external` / `tau_external_std`.
    - `tau_external_statistic`: eᵀ C⁻¹ e of all joints together; χ² with n degrees of freedom without contact.
    - `tau_external_p`: the probability of a larger statistic without contact.
    - `wrench_base` [6]: force, N, and moment about the origin of the last link, N·m, that act on the arm, in the axes
      of the base; `wrench_link`: in the axes of the last link. Only of models with the geometry of a URDF and at least
      6 joints. A singular posture is an error.
    - `wrench_base_std`, `wrench_link_std` [6]: their standard deviations.
    """
    # only for the documentation: `_answer` answers every request
    reply = await _infer(request.scope, await request.body())
    return reply.response()


for _path, _summary, _documented in (
    ("/models/{model}/infer", "Run inference with a model", _ONE),
    ("/models/{model}/versions/{version}/infer", "Run inference with a version", _VERSIONED),
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
