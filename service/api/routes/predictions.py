"""Routes of torque queries, and the echo: what a request costs before anything is computed."""

from __future__ import annotations

from enum import Enum
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Request, Response
from starlette.types import Scope

from service.api.access.scopes import PREDICT, needs
from service.api.dependencies import LoadedModelsDep, PredictionsDep
from service.api.errors import responses
from service.api.route import JSON, OCTETS, Reply, Route, hot_route, is_json, media_type
from service.contract import predictions as schema
from service.foundation.errors import (
    DamagedDataError,
    InvalidRequestError,
    NotFoundError,
    RevisionNotReachedError,
    TooLargeError,
    UnreadableVersionError,
)
from service.inference import comparison, evaluating, predicting
from service.inference.predicting import encode, one_motion, queries
from service.models.loaded import LoadedModels
from service.models.served import ServedModel, wait_for_revision

_CONTENT: dict[str, Any] = {
    "application/json": {"schema": {}, "example": {"q": [0.0, -0.5], "dq": [0.1, 0.0], "ddq": [0.0, 0.5]}},
    "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
}
_DOCUMENTED: dict[str, Any] = {
    "requestBody": {"required": True, "content": _CONTENT},
    "responses": {"200": {"description": "The body as it came", "content": _CONTENT}},
}

echo_hot = APIRouter(tags=["inference"], responses=responses(TooLargeError))


async def _echo(scope: Scope, body: bytes) -> Reply | None:
    if not media_type(scope):
        return None
    return Reply(body, JSON if is_json(scope) else OCTETS)


@needs(PREDICT)
async def echo(request: Request) -> Response:
    """Answer the body as it came, on the way that a query takes, limits and all: JSON as such, anything else as octets,
    so that nobody's page seems to be the service's.

    What a query takes longer is what the service computes; what the echo takes is HTTP, and the measuring client.
    """
    return Reply(await request.body(), OCTETS).response()  # with a media type, it has been answered before


echo_hot.add_api_route(
    "/v1/echo",
    echo,
    methods=["POST"],
    summary="Answer what was sent: the floor of latency benchmarks",
    response_class=Response,
    openapi_extra=_DOCUMENTED,
    route_class_override=hot_route(_echo),
)


_ERRORS = responses(InvalidRequestError, NotFoundError, TooLargeError)
_LATE = responses(RevisionNotReachedError)

_TAGS: list[str | Enum] = ["inference"]
router = APIRouter(prefix="/v1/models", tags=_TAGS, responses=_ERRORS, route_class=Route)
hot = APIRouter(prefix="/v1/models", tags=_TAGS, responses=_ERRORS)
"""The route of a control loop, which the application tries first."""


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    """Answer a query that can be read as it stands: one of a control loop here, any other in a thread."""
    query = queries.decode(body) if is_json(scope) else None
    if query is None:
        return None
    state = scope["app"].state
    loaded: LoadedModels = state.loaded
    model: str = scope["path_params"]["model"]
    served, motion = loaded.hot(model, query.version, query.alias), one_motion(query)
    if query.min_revision is not None:
        served = await wait_for_revision(loaded, model, query.version, query.alias, query.min_revision)
    if served is not None and motion is not None:
        at_once = predicting.predict_now(served, motion, loaded.storage.settings.max_position, query.payload)
        if at_once is not None:
            return Reply(encode(at_once))
    request = queries.request(query)
    return None if request is None else Reply(await _in_thread(loaded, state.turns.predictions, model, request, served))


async def _in_thread(
    loaded: LoadedModels, turns: CapacityLimiter, model: str, request: schema.PredictRequest, served: ServedModel | None
) -> bytes:
    return await to_thread.run_sync(lambda: encode(predicting.predict(loaded, model, request, served)), limiter=turns)


async def _revised(
    loaded: LoadedModels, model: str, request: schema.PredictRequest | schema.EvaluateRequest
) -> ServedModel | None:
    """The version that answers, where the request waits for a revision of it; None where it does not."""
    if request.min_revision is None:
        return None
    return await wait_for_revision(loaded, model, request.version, request.alias, request.min_revision)


@needs(PREDICT)
async def predict(
    loaded: LoadedModelsDep, turns: PredictionsDep, model: str, request: schema.PredictRequest
) -> Response:
    """Answer one query or a batch. Nothing is clipped; `tau_std` grows where the model knows little."""
    # a right query has been answered before: this reads the others, to say what is wrong, or in JSON of other dialects
    served = await _revised(loaded, model, request)
    return Reply(await _in_thread(loaded, turns, model, request, served)).response()


hot.add_api_route(
    "/{model}/predict",
    predict,
    methods=["POST"],
    summary="Torque at a motion, with its uncertainty",
    response_model=schema.PredictResponse,
    responses=_LATE,
    route_class_override=hot_route(_answer),
)


@router.post("/{model}/evaluate", summary="Compare a model with a data set", responses=_LATE)
@needs(PREDICT)
async def evaluate(
    loaded: LoadedModelsDep, turns: PredictionsDep, model: str, request: schema.EvaluateRequest
) -> schema.EvaluateResponse:
    """Error, coverage and density of the model's torques against measured ones, joint by joint."""
    served = await _revised(loaded, model, request)
    return await to_thread.run_sync(evaluating.evaluate, loaded, model, request, served, limiter=turns)


@router.post("/{model}/trace", summary="Follow a model along a data set", responses=responses(DamagedDataError))
@needs(PREDICT)
async def trace_model(
    loaded: LoadedModelsDep, turns: PredictionsDep, model: str, request: schema.TraceRequest
) -> schema.TraceResponse:
    """Measured torque beside the model's, row by row, for a plot: mean, both standard deviations and components.

    Where there are more rows than points, rows are chosen evenly. Each is shown as it was measured and predicted, and
    the share of them outside the interval is fair, but a peak between two of them is missing: ask for fewer rows to
    see all.
    """
    return await to_thread.run_sync(evaluating.trace, loaded, model, request, limiter=turns)


@router.post(
    "/{model}/compare",
    summary="Compare two versions on a data set",
    tags=["models"],
    responses=responses(NotFoundError, UnreadableVersionError, DamagedDataError),
)
@needs(PREDICT)
async def compare(
    loaded: LoadedModelsDep, turns: PredictionsDep, model: str, request: schema.CompareRequest
) -> schema.CompareResponse:
    """Which of two versions predicts a data set better, joint by joint and over all, and whether that may be chance."""
    return await to_thread.run_sync(comparison.compare, loaded, model, request, limiter=turns)
