"""Routes of the Open Inference Protocol, and models and versions as it names and describes them."""

from __future__ import annotations

import re
from enum import Enum

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from lipcore.model.torque_model import TorqueModel
from service import __version__
from service.foundation.errors import NotFoundError, NotReadyError, UnreadableVersionError, problem, sentence
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.models.schema import ALIAS
from service.oip import query, schema, wire
from service.oip.query import shapes
from service.web.observability import readiness as health
from service.web.observability.readiness import ReadinessDep
from service.web.route import Reply, Route, hot_route

_LISTED = 20


async def find(loaded: LoadedModels, turns: CapacityLimiter, name: str, version: str | None) -> Served:
    """Return a version by its number or an alias, the one that serves where None, loaded if need be. turns: of what
    loads. Raise NotFoundError naming those there are."""
    number, alias = (None, None) if version is None else _meant(version)
    served = loaded.hot(name, number, alias)
    if served is not None:
        return served
    return await to_thread.run_sync(_load, loaded, name, version, number, alias, limiter=turns)


def metadata(loaded: LoadedModels, served: Served) -> schema.ModelMetadata:
    """Describe a version and name all of its model; raise NotFoundError. Not for the event loop."""
    model = served.model
    inputs = [schema.TensorMetadata(name=each, shape=[-1, model.n_joints]) for each in schema.INPUTS]
    inputs.append(schema.TensorMetadata(name=schema.TORQUE, shape=[-1, model.n_joints], parameters={"optional": True}))
    return schema.ModelMetadata(
        name=served.name,
        versions=_known(loaded, served.name),
        platform=f"lipserve_{model.estimator.name}",
        inputs=inputs,
        outputs=[schema.TensorMetadata(name=each, shape=list(shape)) for each, shape in shapes(model).items()],
        parameters=_parameters(served, model),
    )


def _parameters(served: Served, model: TorqueModel) -> dict[str, str | int]:
    return {
        "version": str(served.version),
        "revision": served.revision,
        "torque_convention": model.torque_convention,
        "joint_names": ",".join(model.joint_names),
    }


def _meant(version: str) -> tuple[int | None, str | None]:
    """A version's number or an alias; the number 0, which no version has, for what is neither."""
    if re.fullmatch(ALIAS, version):
        return None, version
    number = int(version) if version.isascii() and version.isdigit() and len(version) < 10 else 0
    return number if str(number) == version else 0, None


def _load(loaded: LoadedModels, name: str, version: str | None, number: int | None, alias: str | None) -> Served:
    try:
        return loaded.get(name, number, alias)
    except NotFoundError as error:
        if error.detail[0].field == "model":
            raise NotFoundError(f"no model {name[:200]!r}: GET /v1/models lists all", error.detail) from error
        known = [*registry.show(loaded.database, name).aliases, *_known(loaded, name)]
        item = problem("version", version, f"one of {', '.join(known[-_LISTED:])}")
        raise NotFoundError(f"{sentence(item)}, of model {name!r}", [item]) from error


def _known(loaded: LoadedModels, name: str) -> list[str]:
    return [str(each.version) for each in registry.show(loaded.database, name).versions]


SMALL = 16 * 1024
"""Bytes of a body that is decoded on the event loop: one query of the largest robot fits many times."""

_ONE, _VERSIONED = {"parameters": [schema.MODEL]}, {"parameters": [schema.MODEL, schema.VERSION]}
_TAGS: list[str | Enum] = ["open inference protocol"]

router = APIRouter(prefix="/v2", tags=_TAGS, route_class=Route)
hot = APIRouter(prefix="/v2", tags=_TAGS)
"""The routes of inference, to be tried before all others: FastAPI tries one route after the other, 2 µs each."""


@router.get("", summary="What serves")
async def server_metadata() -> schema.ServerMetadata:
    """Name, version, and the extensions of the protocol that are supported."""
    return schema.ServerMetadata(name="lipserve", version=__version__, extensions=[schema.BINARY])


@router.get("/health/live", summary="Is the server alive?")
async def live() -> schema.ServerLive:
    """Answer while the event loop turns."""
    return schema.ServerLive()


@router.get("/health/ready", summary="Can the server answer?", responses=schema.failures(503))
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
async def model_metadata(request: Request) -> schema.ModelMetadata:
    """Inputs that a request brings, outputs that it may ask for, and the versions there are."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    served = await find(loaded, turns, where["model"], where.get("version"))
    return await to_thread.run_sync(metadata, loaded, served)


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
async def model_ready(request: Request) -> schema.ModelReady:
    """Answer once the version is in memory; it is loaded if it is not."""
    loaded: LoadedModels = request.app.state.loaded
    turns = request.app.state.turns.predictions
    where = request.path_params
    try:
        served = await find(loaded, turns, where["model"], where.get("version"))
    except UnreadableVersionError as error:
        raise NotReadyError(error.message) from error
    return schema.ModelReady(name=served.name)


async def _answer(scope: Scope, body: bytes) -> Reply:
    """Answer any request, a wrong one with the error that it raises: one query here, all else in a thread."""
    loaded: LoadedModels = scope["app"].state.loaded
    limiter, settings = scope["app"].state.turns.predictions, loaded.storage.settings
    headers, where = scope["headers"], scope["path_params"]
    served = await find(loaded, limiter, where["model"], where.get("version"))
    if len(body) > SMALL:
        return await to_thread.run_sync(query.infer, served, body, headers, settings, limiter=limiter)
    message = wire.decode(body, headers)
    question = query.read_question(served, message, body, settings)
    if question.quick:
        return query.respond(served, message.request, question)
    return await to_thread.run_sync(query.respond, served, message.request, question, limiter=limiter)


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
