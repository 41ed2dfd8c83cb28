"""Routes of torque queries."""

from __future__ import annotations

from anyio import to_thread
from fastapi import APIRouter

from service.context import ServiceDep
from service.errors import InvalidRequestError, NotFoundError, TooLargeError, responses
from service.inference import answer
from service.inference.schema import EvaluateRequest, EvaluateResponse, PredictRequest, PredictResponse

_ERRORS = responses(InvalidRequestError, NotFoundError, TooLargeError)

router = APIRouter(prefix="/v1/models", tags=["inference"], responses=_ERRORS)


@router.post(
    "/{model}/predict",
    summary="Torque at a motion, with its uncertainty",
    response_model_exclude_none=True,
)
async def predict(service: ServiceDep, model: str, request: PredictRequest) -> PredictResponse:
    """Answer one query or a batch. Nothing is clipped; `tau_std` grows where the model knows little."""
    return await to_thread.run_sync(answer.predict, service, model, request, limiter=service.predictions)


@router.post("/{model}/evaluate", summary="Compare a model with a data set")
async def evaluate(service: ServiceDep, model: str, request: EvaluateRequest) -> EvaluateResponse:
    """Error, coverage and density of the model's torques against measured ones, joint by joint."""
    return await to_thread.run_sync(answer.evaluate, service, model, request, limiter=service.predictions)
