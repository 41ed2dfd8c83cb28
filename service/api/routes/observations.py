"""Route of observation batches, which are decoded and stored in a thread, away from the event loop."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.types import Scope

from service.api.access.scopes import UPDATE, needs
from service.api.dependencies import LearnersDep
from service.api.errors import responses
from service.api.route import Reply, hot_route, is_json
from service.contract.decoding import HotDecoder
from service.contract.observations import ExpiredError, ObservationRequest, ObservationResponse
from service.foundation.errors import BusyError, ConflictError, InvalidRequestError, NotFoundError, TooLargeError
from service.learning.learners import Learners

batches: HotDecoder[ObservationRequest] = HotDecoder(ObservationRequest, apart=True)

hot = APIRouter(
    prefix="/v1/models",
    tags=["learning"],
    responses=responses(
        InvalidRequestError,
        NotFoundError,
        TooLargeError,
        ConflictError,
        ExpiredError,
        BusyError,
    ),
)
"""Matched before all other routes. Bodies that pydantic would parse slowly are decoded in a thread."""


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    """Answer a batch that needs no further checks; return None for any other."""
    if not is_json(scope):
        return None
    learners: Learners = scope["app"].state.learners
    model = scope["path_params"]["model"]
    reply = await learners.threads.run(model, _decoded, learners, model, body)
    return None if reply is None else Reply(reply)


def _decoded(learners: Learners, model: str, body: bytes) -> bytes | None:
    batch = batches.decode(body)
    request = None if batch is None else batches.request(batch)
    return None if request is None else learners.observe(model, request).model_dump_json().encode()


@needs(UPDATE)
async def observe(learners: LearnersDep, model: str, request: ObservationRequest) -> ObservationResponse:
    """Store a batch of measured rows to learn from. The batch is durable once it is answered, and learnt soon after.

    - Every row is predicted before it is learnt. Rows that the model cannot explain are stored and counted, but not
      learnt.
    - If no answer arrives, send the same batch again: it is applied once. Batches may arrive in any order.
    - Times must increase within a stream. If a robot's clock was set back, continue with a new `stream_id`.
    - If your joints have another order than the model's, give `joint_names`.
    - Batches of 0.1 s to 1 s work best.
    """
    return await learners.threads.run(model, learners.observe, model, request)


hot.add_api_route(
    "/{model}/observations",
    observe,
    methods=["POST"],
    summary="Send an observation batch",
    response_model=ObservationResponse,
    route_class_override=hot_route(_answer),
)
