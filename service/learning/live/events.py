"""A model's live feed as server-sent events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Depends
from fastapi.sse import ServerSentEvent

from service.learning.live.status import Status
from service.learning.updates import Updates, UpdatesDep
from service.web.observability.meters import Meters


def _name(updates: UpdatesDep, model: str) -> str:
    return updates.loaded.get(model, None).name


async def _followed(updates: UpdatesDep, name: Annotated[str, Depends(_name)]) -> AsyncIterator[str]:
    """The model's name; one more reader is counted while the answer lasts."""
    with updates.live.one_more(updates.settings.max_live_followers):
        yield name


FollowedDep = Annotated[str, Depends(_followed)]


async def events(
    updates: Updates, meters: Meters, closing: asyncio.Event, model: str
) -> AsyncIterator[ServerSentEvent]:
    """`status` at the start and once a second, `rows` as they come; see `schema`."""
    feed = updates.live
    async for said in feed.follow(model, Status(updates, meters, model), closing):
        yield ServerSentEvent(event=said.event, raw_data=said.data)
