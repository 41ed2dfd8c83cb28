"""A model's live feed as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Depends
from fastapi.sse import ServerSentEvent

from service.context import Service, ServiceDep
from service.learning.live.status import Status


def _name(service: ServiceDep, model: str) -> str:
    return service.loaded.get(model, None).name


async def _followed(service: ServiceDep, name: Annotated[str, Depends(_name)]) -> AsyncIterator[str]:
    """The model's name; one more reader is counted while the answer lasts."""
    with service.updates.live.one_more(service.settings.max_live_followers):
        yield name


FollowedDep = Annotated[str, Depends(_followed)]


async def events(service: Service, model: str) -> AsyncIterator[ServerSentEvent]:
    """`status` at the start and once a second, `rows` as they come; see `schema`."""
    feed = service.updates.live
    async for said in feed.follow(model, Status(service, model), service.stopping.closing):
        yield ServerSentEvent(event=said.event, raw_data=said.data)
