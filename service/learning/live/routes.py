"""The route that follows a model live."""

from __future__ import annotations

from collections.abc import AsyncIterable

from fastapi import APIRouter
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.foundation.errors import BusyError, InvalidRequestError, NotFoundError, responses
from service.learning.live import events
from service.learning.updates import UpdatesDep
from service.web.observability.meters import MetersDep
from service.web.observability.readiness import StoppingDep
from service.web.route import Route

router = APIRouter(
    prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError, NotFoundError), route_class=Route
)


@router.get(
    "/{model}/live",
    summary="Follow a model live",
    response_class=EventSourceResponse,
    responses=responses(BusyError),
)
async def follow(
    updates: UpdatesDep, meters: MetersDep, stopping: StoppingDep, model: events.FollowedDep
) -> AsyncIterable[ServerSentEvent]:
    """Server-sent events of what streams and batches bring with measured torque, predicted before it is learnt.

    `rows`, at most ten a second: `parts`, each of one stream and revision, with torque measured, mean, standard
    deviations and code of some `LIPSERVE_LIVE_ROWS_PER_S` rows a second; all rows are counted by code. `status`, at the
    start and about once a second: version, revision, counters, quality, latency of streams, alarms, and whether
    learning waits for a decision. `lost`: so many events were dropped because they were not read in time. The answer
    ends when the model is deleted or the service stops.
    """
    async for event in events.events(updates, meters, stopping.closing, model):
        yield event
