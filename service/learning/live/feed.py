"""The live feed of models for any number of readers.

Each model is read once for all of its readers. Of the batches of a tick, few rows are shown, but all are counted.
"""

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
from service.contract.live import DECIMALS, LiveLost, LiveNovelty, LivePart, LiveRows, LiveStatus
from service.foundation.errors import NotFoundError
from service.learning.ingest.append import LoggedBatch
from service.models.loaded import ServedModel
from service.runtime.counted import OpenCounter

logger = logging.getLogger(__name__)

MAX_NOVELTY_ROWS = 20
"""Max rows of a stream that are tested for one status: 14 ms of a thread at a thousand inducing outputs."""
MAX_FOLLOWERS = 20
"""Max clients of live feeds. Further clients are answered 429."""
ROWS_PER_S = 50
"""Max rows per second that a client gets. All rows are counted."""


MAX_POSITION = 1e6
"""Max position of a robot, rad or m. Rows with a larger or non-finite position are ignored."""


@dataclass(frozen=True)
class ShownRows:
    """The rows that are shown, with their predictions before they were learnt."""

    stream_id: str
    served: ServedModel
    rows: Rows
    """Shown rows, (N,)."""
    mean: Array
    """Predicted torque, (N, n), NaN for rows without a prediction. `std` and `bare` have the same shape."""
    std: Array
    bare: Array
    """Standard deviation without the floor of past errors, as in `PredictedBatch`."""


def thin_batches(batches: Iterable[LoggedBatch], most: int) -> list[tuple[LivePart, ShownRows]]:
    """Return the parts to show, by stream and revision, in order.

    They have about `most` rows in total, and at least one each.
    """
    groups = [list(group) for _, group in groupby(batches, lambda each: (each.stream_id, id(each.served)))]
    total = sum(len(batch.rows) for group in groups for batch in group)
    return [_part(group, most, total) for group in groups]


def choose_rows(code: NDArray[np.uint8], most: int) -> NDArray[np.int64]:
    """Return the indices of at most `most` rows (at least one) with these codes, in order, without those at an edge.

    Each stretch contributes one row: the first that was kept out, if any, so that no stretch looks calmer than it was.
    """
    places = np.flatnonzero(code != Code.EDGE)
    if len(places) <= most:
        return places
    kept_out = code[places] != Code.LEARNT
    starts = np.linspace(0, len(places), max(most, 1), endpoint=False).astype(np.int64)
    chosen = [start + int(kept_out[start:end].argmax()) for start, end in zip(starts, [*starts[1:], None], strict=True)]
    return places[chosen]


def _part(group: Sequence[LoggedBatch], most: int, total: int) -> tuple[LivePart, ShownRows]:
    served, stream_id = group[0].served, group[0].stream_id
    rows = Rows.concatenate([batch.rows for batch in group])
    mean, std, bare = (np.concatenate([_spread(batch, name) for batch in group]) for name in ("mean", "std", "bare"))
    noise = served.model.noise_std
    count = np.bincount(rows.code, minlength=len(CODES))
    chosen = choose_rows(rows.code, max(most * len(rows) // max(total, 1), 1))
    picked = ShownRows(stream_id, served, rows.take(chosen), mean[chosen], std[chosen], bare[chosen])
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


def _spread(batch: LoggedBatch, name: str) -> Array:
    """Return numbers of the predicted rows, (P, n), as those of all rows, (N, n), NaN without a prediction."""
    values = np.full(batch.rows.q.shape, np.nan)
    values[batch.screened.predicted] = getattr(batch.screened, name)
    return values


def _worst(error: Array, total: Array) -> list[float | None]:
    """Return the largest |error| / total of each joint; None if no row was predicted."""
    known = np.isfinite(error).all(axis=1)
    if not known.any():
        return [None] * error.shape[1]
    worst: list[float | None] = np.round(np.abs(error[known] / total[known]).max(axis=0), 3).tolist()
    return worst


def find_novel_rows(picked_rows: Iterable[ShownRows]) -> list[LiveNovelty]:
    """Return which of the shown rows lie beyond their versions' bases, for each stream."""
    streams: dict[str, list[ShownRows]] = defaultdict(list)
    for picked in picked_rows:
        streams[picked.stream_id].append(picked)
    return [_find_novel_in_stream(stream_id, parts) for stream_id, parts in streams.items()]


def _find_novel_in_stream(stream_id: str, parts: list[ShownRows]) -> LiveNovelty:
    times: list[float] = []
    unknown = 0
    share = 1.0
    doubtful = [_find_uncertain(picked) for picked in parts]
    if (total := sum(len(places) for places in doubtful)) > MAX_NOVELTY_ROWS:
        share = MAX_NOVELTY_ROWS / total
    for picked, places in zip(parts, doubtful, strict=True):
        few = places[:: int(np.ceil(1 / share))]
        unknown += len(places) - len(few)
        if len(few):
            rows = picked.rows.take(few)
            times += np.round(rows.time[uncovered(picked.served.base, rows)], 6).tolist()
    return LiveNovelty(stream_id=stream_id, times=times, unknown=unknown)


def _find_uncertain(picked: ShownRows) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the indices of rows that may lie beyond the basis.

    The variance that the basis leaves open is part of every answer's variance. If that is below the noise, no further
    computation is needed.
    """
    with np.errstate(invalid="ignore"):
        doubtful = (picked.bare > picked.served.model.noise_std).any(axis=1)
    return np.flatnonzero(doubtful)


TICK_S = 0.1
"""Seconds between two reads of a model's rows, and so between two `rows` events."""
STATUS_S = 1.0
"""Seconds between two `status` events."""
MAX_WAITING_BATCHES = 1000
"""Batches that may wait for a tick. Beyond it, the oldest are not shown."""
MAX_UNREAD_EVENTS = 50
"""Max events that wait for a slow reader: about five seconds.

Beyond it, the oldest are lost, and a `lost` event reports how many.
"""
MAX_SHOWN_S = 2.0
"""Max seconds between two ticks that count for the number of rows: one batch may contain many seconds of them."""

ReadStatus = Callable[[list[LiveNovelty], float | None], LiveStatus]
"""Function that returns a status.

Its arguments are the novel rows among those shown, and the seconds since the last status, None at first.
"""


class FeedEvent(NamedTuple):
    """An event: its kind, and its data as JSON."""

    event: str
    data: str


class Feed(OpenCounter):
    """The live feeds of models. It belongs to the event loop, but for `add_batch` and `forget`.

    positions: the last finite position of each model's robot, rad (m).
    """

    too_many = "{} live views of models are open, the max: close one, or retry later"
    headers: ClassVar = {"Retry-After": "5"}

    def __init__(self) -> None:
        super().__init__()
        self._followed: dict[str, FollowedModel] = {}
        self.positions: dict[str, list[float]] = {}

    def add_batch(self, batch: LoggedBatch) -> None:
        """Add a logged batch: store the robot's position, and show rows to readers of the model. From any thread."""
        known = batch.rows.q[(np.abs(batch.rows.q) < MAX_POSITION).all(axis=1)]
        if len(known):
            self.positions[batch.served.name] = np.round(known[-1], DECIMALS).tolist()
        followed = self._followed.get(batch.served.name)
        if followed is not None:
            followed.waiting.append(batch)

    def forget(self, model: str) -> None:
        """Delete everything about a model that has been deleted. From any thread."""
        self.positions.pop(model, None)

    async def follow(self, model: str, read_status: ReadStatus, closing: asyncio.Event) -> AsyncIterator[FeedEvent]:
        """Yield the events of a model until the service closes or the model is deleted. A status comes first."""
        followed = self._followed.get(model)
        if followed is None or followed.over:
            followed = self._followed[model] = FollowedModel(model, read_status, ROWS_PER_S)
            # in a context of its own, not in that of the first request
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
    """The events that one reader has not read yet. closed: whether there will be no more."""

    def __init__(self) -> None:
        self.closed = False
        self._unread: deque[FeedEvent] = deque()
        self._lost = 0
        self._woken = asyncio.Event()

    def put(self, event: FeedEvent) -> None:
        """Append an event; drop the oldest if there are too many."""
        if len(self._unread) >= MAX_UNREAD_EVENTS:
            self._unread.popleft()
            self._lost += 1
        self._unread.append(event)
        self._woken.set()

    def close(self) -> None:
        """End after the remaining events."""
        self.closed = True
        self._woken.set()

    async def read(self) -> AsyncIterator[FeedEvent]:
        """Yield the events as they are appended."""
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


class FollowedModel:
    """A model with readers.

    waiting: batches that are not shown yet. over: whether the last reader has disconnected.
    """

    def __init__(self, model: str, read_status: ReadStatus, rows_per_s: float) -> None:
        self.model, self._read_status, self._rows_per_s = model, read_status, rows_per_s
        self.waiting: deque[LoggedBatch] = deque(maxlen=MAX_WAITING_BATCHES)
        self.readers: list[Reader] = []
        self.over = False
        self.task: asyncio.Task[None] | None = None
        self._shown: list[ShownRows] = []  # since the last status
        self._status_at: float | None = None
        self._shown_at = monotonic()
        self._is_status_due = True

    def join(self) -> Reader:
        """Add a reader, which gets a status at once."""
        reader = Reader()
        self.readers.append(reader)
        self._is_status_due = True
        return reader

    async def run(self, closing: asyncio.Event) -> None:
        """Send events to the readers until none is left, the model is deleted, or the service closes."""
        try:
            while self.readers and not closing.is_set():
                try:
                    for event in await to_thread.run_sync(self._events):
                        for reader in self.readers:
                            reader.put(event)
                except NotFoundError:  # it was deleted
                    return
                except Exception:  # a database error, which may be over at the next tick
                    logger.exception("could not read the state of model %s for its live view", self.model)
                with suppress(TimeoutError):
                    await asyncio.wait_for(closing.wait(), TICK_S)
        finally:
            self.over = True
            for reader in self.readers:
                reader.close()

    def _events(self) -> list[FeedEvent]:
        """Return the events of this tick. For a thread."""
        now = monotonic()
        events = self._status(now) if self._is_status_due or now - (self._status_at or 0.0) >= STATUS_S else []
        return events + self._rows(now)

    def _rows(self, now: float) -> list[FeedEvent]:
        batches = [self.waiting.popleft() for _ in range(len(self.waiting))]
        if not batches:
            return []
        passed, self._shown_at = min(now - self._shown_at, MAX_SHOWN_S), now
        parts = thin_batches(batches, max(round(self._rows_per_s * passed), 1))
        self._shown += [picked for _, picked in parts]
        return [FeedEvent("rows", LiveRows(parts=[part for part, _ in parts]).model_dump_json())]

    def _status(self, now: float) -> list[FeedEvent]:
        passed = None if self._status_at is None else now - self._status_at
        self._is_status_due, self._status_at = False, now
        picked, self._shown = self._shown, []
        return [FeedEvent("status", self._read_status(find_novel_rows(picked), passed).model_dump_json())]
