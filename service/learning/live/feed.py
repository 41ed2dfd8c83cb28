"""Models as they predict and learn, for any number of readers: each model is looked at once for all of its readers, and
of the batches of a moment few rows are shown, but all of them counted."""

from __future__ import annotations

import asyncio
import logging
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import suppress
from contextvars import Context
from dataclasses import dataclass
from itertools import groupby
from time import monotonic
from typing import ClassVar, NamedTuple

import numpy as np
from anyio import to_thread
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.learner import uncovered
from lipcore.vocabulary import CODES, Code
from service.contract.learning import DECIMALS, LiveLost, LiveNovelty, LivePart, LiveRows, LiveStatus
from service.foundation.errors import NotFoundError
from service.learning.ingest.append import Judged
from service.models.loaded import Served
from service.runtime.counted import Counted

logger = logging.getLogger(__name__)

MOST_LOOKED = 20
"""Rows of a stream that are looked at for one status: 14 ms of a thread at a thousand inducing outputs."""
MAX_FOLLOWERS = 20
"""Readers that follow models live; more are answered 429."""
ROWS_PER_S = 50
"""Rows a second that those who follow a model are shown; all are counted."""


FARTHEST = 1e6
"""rad or m: beyond it no robot is; nor is one where a number is none."""


@dataclass(frozen=True)
class Picked:
    """The rows that are shown, (N,), and their predictions before they were learnt, (N, n), NaN where there are none.
    bare: the standard deviation without the floor of past errors, as `Screened` has it."""

    stream_id: str
    served: Served
    rows: Rows
    mean: Array
    std: Array
    bare: Array


def thinned(batches: Iterable[Judged], most: int) -> list[tuple[LivePart, Picked]]:
    """Show batches in their order, by stream and revision, with about `most` rows in all, one a part at least."""
    groups = [list(group) for _, group in groupby(batches, lambda each: (each.stream_id, id(each.served)))]
    total = sum(len(batch.rows) for group in groups for batch in group)
    return [_part(group, most, total) for group in groups]


def pick(code: NDArray[np.uint8], most: int) -> NDArray[np.int64]:
    """Places of at most so many rows (at least one) of these codes, in order, those at an edge left out. One of each
    stretch: the first that was kept out where there is one, so that no stretch looks calmer than it was."""
    places = np.flatnonzero(code != Code.EDGE)
    if len(places) <= most:
        return places
    kept_out = code[places] != Code.LEARNT
    starts = np.linspace(0, len(places), max(most, 1), endpoint=False).astype(np.int64)
    chosen = [start + int(kept_out[start:end].argmax()) for start, end in zip(starts, [*starts[1:], None], strict=True)]
    return places[chosen]


def _part(group: Sequence[Judged], most: int, total: int) -> tuple[LivePart, Picked]:
    served, stream_id = group[0].served, group[0].stream_id
    rows = Rows.concatenate([batch.rows for batch in group])
    mean, std, bare = (np.concatenate([_spread(batch, name) for batch in group]) for name in ("mean", "std", "bare"))
    noise = served.model.noise_std
    count = np.bincount(rows.code, minlength=len(CODES))
    chosen = pick(rows.code, max(most * len(rows) // max(total, 1), 1))
    picked = Picked(stream_id, served, rows.take(chosen), mean[chosen], std[chosen], bare[chosen])
    part = LivePart(
        stream_id=stream_id,
        version=served.version,
        revision=served.revision,
        rows=len(rows),
        counts={code: int(number) for code, number in zip(CODES, count, strict=True) if number},
        worst=_worst(rows.tau - mean, np.sqrt(std**2 + noise**2)),
        noise_std=noise.tolist(),
        time=np.round(picked.rows.time, DECIMALS).tolist(),
        q=np.round(picked.rows.q[picked.rows.time.argmax()], DECIMALS).tolist() if len(picked.rows) else [],
        tau=np.round(picked.rows.tau, DECIMALS).tolist(),
        mean=np.round(picked.mean, DECIMALS).tolist(),
        std=np.round(picked.std, DECIMALS).tolist(),
        code=[CODES[code] for code in picked.rows.code.tolist()],
    )
    return part, picked


def _spread(batch: Judged, name: str) -> Array:
    """Numbers of the rows that were predicted, (P, n), as those of all rows, (N, n), NaN where there are none."""
    values = np.full(batch.rows.q.shape, np.nan)
    values[batch.screened.predicted] = getattr(batch.screened, name)
    return values


def _worst(error: Array, total: Array) -> list[float | None]:
    """Largest |error| / total of each joint, None where no row was predicted."""
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        return [None] * error.shape[1]
    worst: list[float | None] = np.round(np.abs(error[known] / total[known]).max(axis=0), 3).tolist()
    return worst


def beyond(picked_rows: Iterable[Picked]) -> list[LiveNovelty]:
    """Which of the rows picked lie beyond their versions' bases, stream by stream."""
    streams: dict[str, list[Picked]] = defaultdict(list)
    for picked in picked_rows:
        streams[picked.stream_id].append(picked)
    return [_look(stream_id, parts) for stream_id, parts in streams.items()]


def _look(stream_id: str, parts: list[Picked]) -> LiveNovelty:
    times: list[float] = []
    unknown = 0
    share = 1.0
    doubtful = [_doubtful(picked) for picked in parts]
    if (total := sum(len(places) for places in doubtful)) > MOST_LOOKED:
        share = MOST_LOOKED / total
    for picked, places in zip(parts, doubtful, strict=True):
        few = places[:: int(np.ceil(1 / share))]
        unknown += len(places) - len(few)
        if len(few):
            rows = picked.rows.take(few)
            times += np.round(rows.time[uncovered(picked.served.base, rows)], 6).tolist()
    return LiveNovelty(stream_id=stream_id, times=times, unknown=unknown)


def _doubtful(picked: Picked) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Places of rows that may lie beyond the basis. What the basis leaves open is part of the variance of every answer:
    where that is below the noise's, nothing more needs to be computed."""
    with np.errstate(invalid="ignore"):
        doubtful = (picked.bare > picked.served.model.noise_std).any(axis=1)
    return np.flatnonzero(doubtful)


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


class Feed(Counted):
    """Followers of models. It belongs to the event loop, but for `note` and `forget`.

    positions: of the last row of each model that was finite, rad (m).
    """

    too_many = "models are followed {} times, the most there may be: close one, or try again later"
    headers: ClassVar = {"Retry-After": "5"}

    def __init__(self) -> None:
        super().__init__()
        self._followed: dict[str, Followed] = {}
        self.positions: dict[str, list[float]] = {}

    def note(self, batch: Judged) -> None:
        """Take note of a batch that was logged: where its robot is, and what it shows to those who follow the model.
        From any thread."""
        known = batch.rows.q[(np.abs(batch.rows.q) < FARTHEST).all(axis=1)]
        if len(known):
            self.positions[batch.served.name] = np.round(known[-1], DECIMALS).tolist()
        followed = self._followed.get(batch.served.name)
        if followed is not None:
            followed.waiting.append(batch)

    def forget(self, model: str) -> None:
        """Keep nothing of a model that has been deleted. From any thread."""
        self.positions.pop(model, None)

    async def follow(self, model: str, look: Look, closing: asyncio.Event) -> AsyncIterator[FeedEvent]:
        """Events of a model until the service closes or the model is deleted; a status comes first."""
        followed = self._followed.get(model)
        if followed is None or followed.over:
            followed = self._followed[model] = Followed(model, look, ROWS_PER_S)
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
        self._picked: list[Picked] = []  # since the last status
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
        self._picked += [picked for _, picked in parts]
        return [FeedEvent("rows", LiveRows(parts=[part for part, _ in parts]).model_dump_json())]

    def _status(self, now: float) -> list[FeedEvent]:
        passed = None if self._status_at is None else now - self._status_at
        self._asked, self._status_at = False, now
        picked, self._picked = self._picked, []
        return [FeedEvent("status", self._look(beyond(picked), passed).model_dump_json())]
