"""The route of observations: decoded and taken in a thread, away from the event loop."""

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
"""The application tries it first: what pydantic takes long to read is decoded in a thread."""


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    """Take a batch that can be read as it stands."""
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
    """Take a batch of measured rows to learn from, durable once it is answered, and learnt within a moment.

    Each row is predicted before it is learnt. Rows that cannot be explained are kept and counted, but not learnt. Send
    a batch again until it is answered: it is applied once. Batches may come in any order. Times must rise within a
    stream; a robot whose clock was set goes on under another `stream_id`. Of joints in another order, say
    `joint_names`. Batches of about a tenth of a second to a second serve best.
    """
    return await learners.threads.run(model, learners.observe, model, request)


hot.add_api_route(
    "/{model}/observations",
    observe,
    methods=["POST"],
    summary="Teach a model with measured rows",
    response_model=ObservationResponse,
    route_class_override=hot_route(_answer),
)
