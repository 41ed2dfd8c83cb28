"""Models as they predict and learn, for any number of readers: each is looked at once for all of them."""

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
from service.learning.live.novelty import Novelty
from service.learning.live.schema import LiveLost, LiveNovelty, LiveRows, LiveStatus
from service.learning.live.thinning import Judged, thinned

logger = logging.getLogger(__name__)

TICK_S = 0.1
"""Seconds between two looks at the rows of a model: so many `rows` events there may be."""
STATUS_S = 1.0
"""Seconds between two `status` events."""
MOST_WAITING = 1000
"""Batches that may wait for a look; beyond it the oldest are not shown."""
MOST_UNREAD = 50
"""Events that wait for a slow reader, some five seconds; beyond it the oldest are lost, and that is said."""
LONGEST_S = 2.0
"""Rows are shown as if they had come within this time at most, s: a batch may bring many seconds of them."""

Look = Callable[[list[LiveNovelty], float | None], LiveStatus]
"""Makes a status. Given which rows shown are novel, and how many seconds ago the last status was, None at first."""


class Said(NamedTuple):
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

    async def follow(self, model: str, look: Look, closing: asyncio.Event) -> AsyncIterator[Said]:
        """Events of a model until the service closes or the model is deleted; a status comes first."""
        followed = self._followed.get(model)
        if followed is None or followed.over:
            followed = self._followed[model] = Followed(model, look, self._rows_per_s)
            # in a context of its own, not that of the request that happens to be the first
            run = followed.run(closing)
            followed.task = asyncio.get_running_loop().create_task(run, context=Context())
        reader = followed.join()
        try:
            async for said in reader.read():
                yield said
        finally:
            followed.readers.remove(reader)
            if not followed.readers and self._followed.get(model) is followed:
                del self._followed[model]


class Reader:
    """What one reader has not read yet. closed: nothing more comes."""

    def __init__(self) -> None:
        self.closed = False
        self._unread: deque[Said] = deque()
        self._lost = 0
        self._woken = asyncio.Event()

    def tell(self, said: Said) -> None:
        """Put an event at the end; the oldest goes where there are too many."""
        if len(self._unread) >= MOST_UNREAD:
            self._unread.popleft()
            self._lost += 1
        self._unread.append(said)
        self._woken.set()

    def close(self) -> None:
        """End after what is left."""
        self.closed = True
        self._woken.set()

    async def read(self) -> AsyncIterator[Said]:
        """What there is, as it comes."""
        while True:
            if self._lost:
                lost, self._lost = self._lost, 0
                yield Said("lost", LiveLost(events=lost).model_dump_json())
            elif self._unread:
                yield self._unread.popleft()
            elif self.closed:
                return
            else:
                self._woken.clear()
                await self._woken.wait()


class Followed:
    """One model while somebody follows it. waiting: batches that nobody has been told of. over: nobody is any more."""

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
        """One more reader, who is told the status at once."""
        reader = Reader()
        self.readers.append(reader)
        self._asked = True
        return reader

    async def run(self, closing: asyncio.Event) -> None:
        """Look and tell until nobody listens, or there is nothing to tell any more."""
        try:
            while self.readers and not closing.is_set():
                try:
                    for said in await to_thread.run_sync(self._events):
                        for reader in self.readers:
                            reader.tell(said)
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

    def _events(self) -> list[Said]:
        """What there is to tell now. For a thread."""
        now = monotonic()
        said = self._status(now) if self._asked or now - (self._status_at or 0.0) >= STATUS_S else []
        return said + self._rows(now)

    def _rows(self, now: float) -> list[Said]:
        batches = [self.waiting.popleft() for _ in range(len(self.waiting))]
        if not batches:
            return []
        passed, self._shown_at = min(now - self._shown_at, LONGEST_S), now
        parts = thinned(batches, max(round(self._rows_per_s * passed), 1))
        for _, shown in parts:
            self._novelty.add(shown)
        return [Said("rows", LiveRows(parts=[part for part, _ in parts]).model_dump_json())]

    def _status(self, now: float) -> list[Said]:
        passed = None if self._status_at is None else now - self._status_at
        self._asked, self._status_at = False, now
        return [Said("status", self._look(self._novelty.look(), passed).model_dump_json())]
