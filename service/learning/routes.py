"""The route of observations."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.types import Scope

from service.foundation.errors import (
    BusyError,
    ConflictError,
    InvalidRequestError,
    NotFoundError,
    TooLargeError,
    responses,
)
from service.learning.errors import ExpiredError, LearningDisabledError
from service.learning.ingest import wire
from service.learning.schema import ObservationRequest, ObservationResponse
from service.learning.updates import Updates, UpdatesDep
from service.web.route import Reply, hot_route, is_json

hot = APIRouter(
    prefix="/v1/models",
    tags=["learning"],
    responses=responses(
        InvalidRequestError,
        NotFoundError,
        TooLargeError,
        ConflictError,
        ExpiredError,
        LearningDisabledError,
        BusyError,
    ),
)
"""The application tries it first: what pydantic takes long to read is decoded in a thread."""


async def _answer(scope: Scope, body: bytes) -> Reply | None:
    """Take a batch that can be read as it stands."""
    if not is_json(scope):
        return None
    updates: Updates = scope["app"].state.updates
    reply = await updates.threads.run(_decoded, updates, scope["path_params"]["model"], body)
    return None if reply is None else Reply(reply)


def _decoded(updates: Updates, model: str, body: bytes) -> bytes | None:
    request = wire.decode(body)
    return None if request is None else updates.observe(model, request).model_dump_json().encode()


async def observe(updates: UpdatesDep, model: str, request: ObservationRequest) -> ObservationResponse:
    """Take a batch of measured rows to learn from, durable once it is answered, and learnt within a moment.

    Each row is predicted before it is learnt. Rows that cannot be explained are kept and counted, but not learnt. Send
    a batch again until it is answered: it is applied once. Batches may come in any order. Times must rise within a
    stream; a robot whose clock was set goes on under another `stream_id`. Of joints in another order, say
    `joint_names`. Batches of about a tenth of a second to a second serve best.
    """
    return await updates.threads.run(updates.observe, model, request)


hot.add_api_route(
    "/{model}/observations",
    observe,
    methods=["POST"],
    summary="Teach a model with measured rows",
    response_model=ObservationResponse,
    route_class_override=hot_route(_answer),
)
