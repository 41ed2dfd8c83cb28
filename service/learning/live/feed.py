"""Models as they predict and learn, for any number of readers: each model is looked at once for all of its readers."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import Context
from time import monotonic
from typing import NamedTuple

from anyio import to_thread

from service.foundation.errors import BusyError, NotFoundError
from service.foundation.settings import Settings
from service.learning.ingest.intake import Judged
from service.learning.live.schema import LiveLost, LiveNovelty, LiveRows, LiveStatus
from service.learning.live.thinning import Novelty, thinned

logger = logging.getLogger(__name__)

TICK_S = 0.1
"""Seconds between two looks at the rows of a model: so many `rows` events there may be."""
STATUS_S = 1.0
"""Seconds between two `status` events."""
MOST_WAITING = 1000
"""Batches that may wait for a look; beyond it the oldest are not shown."""
MOST_UNREAD = 50
"""Events that wait for a slow reader, some five seconds; beyond it the oldest are lost, and a `lost` event says so."""
LONGEST_S = 2.0
"""Rows are shown as if they had arrived within this time at most, s: a batch may bring many seconds of them."""

Look = Callable[[list[LiveNovelty], float | None], LiveStatus]
"""Makes a status. Given which rows shown are novel, and how many seconds ago the last status was, None at first."""


class FeedEvent(NamedTuple):
    """An event: its kind, and its data as JSON."""

    event: str
    data: str


class Feed:
    """Followers of models. It belongs to the event loop, but for `note`."""

    def __init__(self, settings: Settings) -> None:
        self.open = 0
        self._rows_per_s = settings.live_rows_per_s
        self._followed: dict[str, Followed] = {}

    def note(self, batch: Judged) -> None:
        """Take note of a batch that was logged, where somebody follows its model. From any thread."""
        followed = self._followed.get(batch.served.name)
        if followed is not None:
            followed.waiting.append(batch)

    @contextmanager
    def one_more(self, most: int) -> Iterator[None]:
        """Count a reader while it lasts; raise BusyError beyond `most`."""
        if self.open >= most:
            raise BusyError(
                f"models are followed {self.open} times, the most there may be: close one, or try again later",
                headers={"Retry-After": "5"},
            )
        self.open += 1
        try:
            yield
        finally:
            self.open -= 1

    async def follow(self, model: str, look: Look, closing: asyncio.Event) -> AsyncIterator[FeedEvent]:
        """Events of a model until the service closes or the model is deleted; a status comes first."""
        followed = self._followed.get(model)
        if followed is None or followed.over:
            followed = self._followed[model] = Followed(model, look, self._rows_per_s)
            # in a context of its own, not that of the request that happens to be the first
            run = followed.run(closing)
            followed.task = asyncio.get_running_loop().create_task(run, context=Context())
        reader = followed.join()
        try:
            async for event in reader.read():
                yield event
        finally:
            followed.readers.remove(reader)
            if not followed.readers and self._followed.get(model) is followed:
                del self._followed[model]


class Reader:
    """The events that one reader has not read yet. closed: there will be no more."""

    def __init__(self) -> None:
        self.closed = False
        self._unread: deque[FeedEvent] = deque()
        self._lost = 0
        self._woken = asyncio.Event()

    def put(self, event: FeedEvent) -> None:
        """Put an event at the end; the oldest goes where there are too many."""
        if len(self._unread) >= MOST_UNREAD:
            self._unread.popleft()
            self._lost += 1
        self._unread.append(event)
        self._woken.set()

    def close(self) -> None:
        """End after what is left."""
        self.closed = True
        self._woken.set()

    async def read(self) -> AsyncIterator[FeedEvent]:
        """The events, as they are put in."""
        while True:
            if self._lost:
                lost, self._lost = self._lost, 0
                yield FeedEvent("lost", LiveLost(events=lost).model_dump_json())
            elif self._unread:
                yield self._unread.popleft()
            elif self.closed:
                return
            else:
                self._woken.clear()
                await self._woken.wait()


class Followed:
    """One model while it has readers. waiting: batches that are not shown yet. over: it has no readers any more."""

    def __init__(self, model: str, look: Look, rows_per_s: float) -> None:
        self.model, self._look, self._rows_per_s = model, look, rows_per_s
        self.waiting: deque[Judged] = deque(maxlen=MOST_WAITING)
        self.readers: list[Reader] = []
        self.over = False
        self.task: asyncio.Task[None] | None = None
        self._novelty = Novelty()
        self._status_at: float | None = None
        self._shown_at = monotonic()
        self._asked = True

    def join(self) -> Reader:
        """Add a reader, who gets a status at once."""
        reader = Reader()
        self.readers.append(reader)
        self._asked = True
        return reader

    async def run(self, closing: asyncio.Event) -> None:
        """Look and pass on events until there is no reader left, or the model is deleted, or the service closes."""
        try:
            while self.readers and not closing.is_set():
                try:
                    for event in await to_thread.run_sync(self._events):
                        for reader in self.readers:
                            reader.put(event)
                except NotFoundError:  # it was deleted
                    return
                except Exception:  # of the database: the next look may find it well again
                    logger.exception("model %s, which is followed, could not be looked at", self.model)
                with suppress(TimeoutError):
                    await asyncio.wait_for(closing.wait(), TICK_S)
        finally:
            self.over = True
            for reader in self.readers:
                reader.close()

    def _events(self) -> list[FeedEvent]:
        """The events of this moment. For a thread."""
        now = monotonic()
        events = self._status(now) if self._asked or now - (self._status_at or 0.0) >= STATUS_S else []
        return events + self._rows(now)

    def _rows(self, now: float) -> list[FeedEvent]:
        batches = [self.waiting.popleft() for _ in range(len(self.waiting))]
        if not batches:
            return []
        passed, self._shown_at = min(now - self._shown_at, LONGEST_S), now
        parts = thinned(batches, max(round(self._rows_per_s * passed), 1))
        for _, picked in parts:
            self._novelty.add(picked)
        return [FeedEvent("rows", LiveRows(parts=[part for part, _ in parts]).model_dump_json())]

    def _status(self, now: float) -> list[FeedEvent]:
        passed = None if self._status_at is None else now - self._status_at
        self._asked, self._status_at = False, now
        return [FeedEvent("status", self._look(self._novelty.look(), passed).model_dump_json())]
