"""The route that follows a model live."""

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
from service.learning.live.look import StatusReader
from service.telemetry.meters import Meters


def _name(learners: LearnersDep, model: str) -> str:
    return learners.loaded.get(model, None).name


async def _followed(learners: LearnersDep, name: Annotated[str, Depends(_name)]) -> AsyncIterator[str]:
    """The model's name; one more reader is counted while the answer lasts."""
    with learners.live.count_one(MAX_FOLLOWERS):
        yield name


FollowedDep = Annotated[str, Depends(_followed)]


async def events(
    learners: Learners, meters: Meters, closing: asyncio.Event, model: str
) -> AsyncIterator[ServerSentEvent]:
    """`status` at the start and once a second, `rows` as they come; see `schema`."""
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
    """Server-sent events of what streams and batches bring with measured torque, predicted before it is learnt.

    `rows`, at most ten a second: `parts`, each of one stream and revision, with torque measured, mean, standard
    deviations and code of some 50 rows a second; all rows are counted by code. `status`, at the
    start and about once a second: version, revision, counters, quality, latency of streams, alarms, and whether
    learning waits for a decision. `lost`: so many events were dropped because they were not read in time. The answer
    ends when the model is deleted or the service stops.
    """
    async for event in events(learners, meters, stopping.closing, model):
        yield event
