"""Routes of torque queries, and the echo, which measures the latency of a request without computation."""

from __future__ import annotations

from collections.abc import Awaitable
from enum import Enum
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Request, Response
from starlette.datastructures import State
from starlette.types import Scope

from service.api.access.scopes import PREDICT, needs
from service.api.dependencies import LoadedModelsDep, PredictionsDep
from service.api.elsewhere import Elsewhere, ElsewhereDep
from service.api.errors import responses
from service.api.limits.requests import in_turn
from service.api.route import JSON, OCTETS, Reply, Route, hot_route, is_json, media_type
from service.contract import predictions as schema
from service.contract.wrench import GravityRequest, GravityResponse, WrenchRequest, WrenchResponse
from service.foundation.errors import (
    DamagedDataError,
    InvalidRequestError,
    NotFoundError,
    RevisionNotReachedError,
    TooLargeError,
    UnreadableVersionError,
)
from service.inference import comparison, evaluating, predicting
from service.inference.gravity import gravity as gravity_torque
from service.inference.predicting import MAX_SHORT_BODY, encode, is_long, one_motion, queries, version_of
from service.inference.wrench import wrench as external_wrench
from service.models.loaded import LoadedModels
from service.models.served import AnsweringModels, ServedModel, wait_for_revision

_CONTENT: dict[str, Any] = {
    "application/json": {"schema": {}, "example": {"q": [0.0, -0.5], "dq": [0.1, 0.0], "ddq": [0.0, 0.5]}},
    "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
}
_DOCUMENTED: dict[str, Any] = {
    "requestBody": {"required": True, "content": _CONTENT},
    "responses": {"200": {"description": "The unchanged body", "content": _CONTENT}},
}

echo_hot = APIRouter(tags=["inference"], responses=responses(TooLargeError))


async def answer_echo(scope: Scope, body: bytes) -> Reply | None:
    """Return the body; None if it has no media type."""
    if not media_type(scope):
        return None
    return Reply(body, JSON if is_json(scope) else OCTETS)


@needs(PREDICT)
async def echo(request: Request) -> Response:
    """Return the body unchanged, through the same checks and limits as a query.

    Use it to measure latency: the echo takes the time of HTTP and of the client. The extra time of a query is the
    computation. JSON is returned as JSON, anything else as `application/octet-stream`.
    """
    # requests with a media type are answered by `answer_echo`. Octets: the body must never be shown as a page
    return Reply(await request.body(), OCTETS).response()


echo_hot.add_api_route(
    "/v1/echo",
    echo,
    methods=["POST"],
    summary="Echo a body",
    response_class=Response,
    openapi_extra=_DOCUMENTED,
    route_class_override=hot_route(answer_echo),
)


_ERRORS = responses(InvalidRequestError, NotFoundError, TooLargeError)
_LATE = responses(RevisionNotReachedError)

_TAGS: list[str | Enum] = ["inference"]
router = APIRouter(prefix="/v1/models", tags=_TAGS, responses=_ERRORS, route_class=Route)
hot = APIRouter(prefix="/v1/models", tags=_TAGS, responses=_ERRORS)
"""Route of control loops, matched before all other routes."""


async def _answer(scope: Scope, body: bytes) -> Reply | Awaitable[Reply | None] | None:
    """Answer a query that needs no further checks; return None for any other.

    A query of a control loop is computed here, a short one in a thread, any other elsewhere.
    """
    if not is_json(scope):
        return None
    state, model = scope["app"].state, scope["path_params"]["model"]
    if len(body) > MAX_SHORT_BODY:
        chosen = version_of(body)
        return None if chosen is None else _answer_long(state, model, chosen, body)
    query = queries.decode(body)
    if query is None:
        return None
    loaded: LoadedModels = state.loaded
    reply, served = answer_query(loaded, model, query), None
    if reply is None and query.min_revision is not None:
        served = await wait_for_revision(loaded, model, query.version, query.alias, query.min_revision)
        reply = answer_query(loaded, model, query)
    if reply is not None:
        return reply
    if is_long(query):
        return _answer_long(state, model, query, body)
    request = queries.request(query)
    return None if request is None else Reply(await _in_thread(state, model, request, served))


async def answer_at_once(scope: Scope, body: bytes) -> Reply | None:
    """Answer a query of a control loop without waiting; return None for any other."""
    query = queries.decode(body) if is_json(scope) else None
    return None if query is None else answer_query(scope["app"].state.loaded, scope["path_params"]["model"], query)


def answer_query(loaded: AnsweringModels, model: str, query: Any) -> Reply | None:
    """Answer a decoded query of one motion.

    Return None for any other query, and if its version is not in memory or has not reached its revision.
    """
    motion, served = one_motion(query), loaded.hot(model, query.version, query.alias)
    if motion is None or served is None or served.revision < (query.min_revision or 0):
        return None
    answer = predicting.predict_now(served, motion, loaded.settings.max_position, query.payload)
    return None if answer is None else Reply(encode(answer))


async def _answer_long(state: State, model: str, chosen: Any, body: bytes) -> Reply | None:
    """Answer a query with many motions. chosen: its fields `version`, `alias` and `min_revision`."""
    served = await _find(state.loaded, state.turns.predictions, model, chosen)
    answer = await Elsewhere(state).run(predicting.predict_body, served, body)
    return None if answer is None else Reply(answer)


async def _in_thread(state: State, model: str, request: schema.PredictRequest, served: ServedModel | None) -> bytes:
    loaded: LoadedModels = state.loaded

    def predict() -> bytes:
        found = served or loaded.get(model, request.version, request.alias)
        return predicting.predict(loaded.storage, found, request)

    return await to_thread.run_sync(predict, limiter=state.turns.predictions)


async def _find(loaded: LoadedModels, turns: CapacityLimiter, model: str, chosen: Any) -> ServedModel:
    """Return the version that a request chooses, once it has reached the request's `min_revision`; raise NotFoundError.

    turns: limits how many versions load at a time.
    """
    revision: int | None = chosen.min_revision
    if revision is not None:
        return await wait_for_revision(loaded, model, chosen.version, chosen.alias, revision)
    served = loaded.hot(model, chosen.version, chosen.alias)
    if served is not None:
        return served
    return await in_turn(turns, loaded.get, model, chosen.version, chosen.alias)


@needs(PREDICT)
async def predict(
    loaded: LoadedModelsDep,
    turns: PredictionsDep,
    elsewhere: ElsewhereDep,
    model: str,
    request: schema.PredictRequest,
) -> Response:
    """Predict the torque of one query or a batch, with its standard deviation.

    Inputs and outputs are not clipped. `tau_std` grows far from the training data.
    """
    # correct queries are answered by `_answer`. The others have an error to explain, or unusual JSON
    served = await _find(loaded, turns, model, request)
    return Reply(await elsewhere.run(predicting.predict, served, request)).response()


hot.add_api_route(
    "/{model}/predict",
    predict,
    methods=["POST"],
    summary="Predict torque with uncertainty",
    response_model=schema.PredictResponse,
    responses=_LATE,
    route_class_override=hot_route(_answer),
)


@router.post("/{model}/gravity", summary="Return the gravity torque", response_model=GravityResponse, responses=_LATE)
@needs(PREDICT)
async def gravity(
    loaded: LoadedModelsDep, turns: PredictionsDep, elsewhere: ElsewhereDep, model: str, request: GravityRequest
) -> Response:
    """Return the torque that holds the arm against gravity at one posture or a batch, with its standard deviation.

    It needs neither `dq` nor `ddq`. A torque without gravity is the component `without_gravity` of `predict`.
    """
    return await elsewhere.answer(
        gravity_torque, await _find(loaded, turns, model, request), request, request.q.ndim == 1
    )


@router.post("/{model}/wrench", summary="Return the external wrench", response_model=WrenchResponse, responses=_LATE)
@needs(PREDICT)
async def wrench(
    loaded: LoadedModelsDep, turns: PredictionsDep, elsewhere: ElsewhereDep, model: str, request: WrenchRequest
) -> Response:
    """Return the force and moment on the last link or a tool that explain a measured torque, with their covariance.

    Only for models with the geometry of a URDF (`fixed` or `calibrate`) and at least 6 joints. It is not a safety
    function. Friction does not follow the motion before a state.
    """
    return await elsewhere.answer(
        external_wrench, await _find(loaded, turns, model, request), request, request.q.ndim == 1
    )


@router.post(
    "/{model}/evaluate",
    summary="Evaluate a model on a data set",
    response_model=schema.EvaluateResponse,
    responses=_LATE,
)
@needs(PREDICT)
async def evaluate(
    loaded: LoadedModelsDep, turns: PredictionsDep, elsewhere: ElsewhereDep, model: str, request: schema.EvaluateRequest
) -> Response:
    """Return error, coverage and negative log predictive density of the predicted torque for every joint."""
    return await elsewhere.answer(evaluating.evaluate, await _find(loaded, turns, model, request), request)


@router.post(
    "/{model}/trace",
    summary="Trace predictions along a data set",
    response_model=schema.TraceResponse,
    responses=responses(DamagedDataError),
)
@needs(PREDICT)
async def trace_model(
    loaded: LoadedModelsDep, turns: PredictionsDep, elsewhere: ElsewhereDep, model: str, request: schema.TraceRequest
) -> Response:
    """Return measured and predicted torque row by row, for a plot: mean, both standard deviations and components.

    If there are more rows than points, evenly spaced rows are returned. The share of points outside the interval is
    representative, but peaks between two points are missing. To see every row, ask for a shorter range.
    """
    served = await in_turn(turns, loaded.get, model, request.version, request.alias)
    return await elsewhere.answer(evaluating.trace, served, request)


@router.post(
    "/{model}/compare",
    summary="Compare two versions on a data set",
    tags=["models"],
    response_model=schema.CompareResponse,
    responses=responses(NotFoundError, UnreadableVersionError, DamagedDataError),
)
@needs(PREDICT)
async def compare(
    loaded: LoadedModelsDep, turns: PredictionsDep, elsewhere: ElsewhereDep, model: str, request: schema.CompareRequest
) -> Response:
    """Return which of two versions predicts a data set better, per joint and over all joints.

    The answer also says whether the difference may be due to chance.
    """
    versions = await in_turn(turns, comparison.find_versions, loaded, model, request)
    return await elsewhere.answer(comparison.compare, versions, request)
