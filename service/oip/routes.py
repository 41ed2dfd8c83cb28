"""Routes of the Open Inference Protocol."""

from __future__ import annotations

from enum import Enum

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from service import __version__, health
from service.context import Service, ServiceDep
from service.inference.loaded import Served
from service.oip import answer, versions, wire
from service.oip.openapi import MODEL, VERSION, failures, infer_answer, infer_body
from service.oip.schema import BINARY, ModelMetadata, ModelReady, ServerLive, ServerMetadata, ServerReady

SMALL = 16 * 1024
"""Bytes of a body that is decoded on the event loop: one query of the largest robot fits many times."""


class HotRoute(APIRoute):
    """A POST route that FastAPI documents and that handles requests itself: no dependencies, validation or encoding."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request with the endpoint's response; errors are those of the application to handle."""
        if scope["method"] != "POST":
            await super().handle(scope, receive, send)
            return
        try:
            response: Response = await self.endpoint(Request(scope, receive))
        except ClientDisconnect:
            return
        await response(scope, receive, send)


_ONE, _VERSIONED = {"parameters": [MODEL]}, {"parameters": [MODEL, VERSION]}
_TAGS: list[str | Enum] = ["open inference protocol"]

router = APIRouter(prefix="/v2", tags=_TAGS)
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
def ready(service: ServiceDep) -> ServerReady:
    """Answer once the models are loaded and while the database answers."""
    health.ready(service)
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
    service: Service = request.app.state.service
    return await to_thread.run_sync(versions.metadata, service, await _served(service, request))


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
    service: Service = request.app.state.service
    where = request.path_params
    served = await versions.ready(service, where["model"], where.get("version"))
    return ModelReady(name=served.name)


async def infer(request: Request) -> Response:
    """Answer one query, [n], or a batch, [N, n], in JSON or binary. Only what `outputs` names is computed: `tau` and
    `tau_std` where it names nothing. Nothing is clipped. `noise_std` [n] is the measurement's own deviation; an
    interval that shall hold measurements needs both.
    """
    service: Service = request.app.state.service
    limiter, settings = service.predictions, service.settings
    body, headers = await request.body(), request.scope["headers"]
    served = await _served(service, request)
    if len(body) > SMALL:
        content, head = await to_thread.run_sync(answer.infer, served, body, headers, settings, limiter=limiter)
        return Response(content, headers=head)
    message = wire.decode(body, headers)
    query = answer.question(served, message, body, settings)
    if query.quick:
        content, head = answer.respond(served, message.request, query)
    else:
        content, head = await to_thread.run_sync(answer.respond, served, message.request, query, limiter=limiter)
    return Response(content, headers=head)


async def _served(service: Service, request: Request) -> Served:
    where = request.path_params
    return await versions.find(service, where["model"], where.get("version"))


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
        route_class_override=HotRoute,
    )
