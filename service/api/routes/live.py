"""Route of the live events of a model."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Depends
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.api.access.scopes import READ, needs
from service.api.dependencies import LearnersDep, MetersDep, StoppingDep
from service.api.errors import responses
from service.api.route import Route
from service.foundation.errors import BusyError, InvalidRequestError, NotFoundError
from service.learning.learners import Learners
from service.learning.live.feed import MAX_FOLLOWERS
from service.learning.live.status import StatusReader
from service.telemetry.meters import Meters


def _name(learners: LearnersDep, model: str) -> str:
    return learners.loaded.get(model, None).name


async def _followed(learners: LearnersDep, name: Annotated[str, Depends(_name)]) -> AsyncIterator[str]:
    """Yield the model's name, and count one follower until the answer ends."""
    with learners.live.count_one(MAX_FOLLOWERS):
        yield name


FollowedDep = Annotated[str, Depends(_followed)]


async def events(
    learners: Learners, meters: Meters, closing: asyncio.Event, model: str
) -> AsyncIterator[ServerSentEvent]:
    """Yield `status` at the start and once a second, and `rows` as they arrive."""
    feed = learners.live
    async for event in feed.follow(model, StatusReader(learners, meters, model), closing):
        yield ServerSentEvent(event=event.event, raw_data=event.data)


router = APIRouter(
    prefix="/v1/models", tags=["learning"], responses=responses(InvalidRequestError, NotFoundError), route_class=Route
)


@router.get(
    "/{model}/live",
    summary="Follow a model live",
    response_class=EventSourceResponse,
    responses=responses(BusyError),
)
@needs(READ, lasting=True)
async def follow(
    learners: LearnersDep, meters: MetersDep, stopping: StoppingDep, model: FollowedDep
) -> AsyncIterable[ServerSentEvent]:
    """Stream measured and predicted torque as server-sent events. Rows are predicted before they are learnt.

    - `rows`, at most ten a second: `parts`, each of one stream and revision. A part has the measured torque, mean,
      standard deviations and code of about 50 rows a second, and counts all rows by code.
    - `status`, at the start and about once a second: version, revision, counters, quality, latency of streams, alarms,
      and whether learning is paused until a person decides.
    - `lost`: the number of events that were dropped because the client did not read them in time.

    The stream ends when the model is deleted or the service stops.
    """
    async for event in events(learners, meters, stopping.closing, model):
        yield event
