"""Frames that carry measured torque: gathered while the stream goes on, and logged a block at a time."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from lipcore.data.samples import Array
from service.contract.frames import NUMBER, REQUEST
from service.foundation.errors import ErrorBody, ServiceError, invalid_request
from service.learning.ingest.clock import MIN_STEP_S
from service.learning.ingest.frames import Frames
from service.learning.learners import Learners
from service.models.loaded import ServedModel
from service.storage.errors import translate_error

logger = logging.getLogger(__name__)


class Taught(NamedTuple):
    """A frame to learn from. served: what answered it; loaded: whether with a load; arrived: time of
    `time.perf_counter`. request: the whole frame; answer: bytes of the posterior's mean and standard deviation, (2, n),
    made before it is learnt; factor: (n,), on the half width of its interval."""

    served: ServedModel
    loaded: bool
    sequence: int
    arrived: float
    request: bytes
    answer: bytes
    factor: Array


class Learning:
    """What one connection teaches. One block at a time is logged, in order; what comes meanwhile waits. stream_id:
    source of the torques; send: sends a text to the client. For the event loop; logging is done in a thread."""

    def __init__(self, learners: Learners, stream_id: str, send: Callable[[str], Awaitable[None]]) -> None:
        self._learners, self._stream_id, self._send = learners, stream_id, send
        self._most, self._wait = learners.settings.stream_flush_rows, learners.settings.stream_flush_s
        self._clock = time.time() - perf_counter()
        self._waiting: deque[Taught] = deque()
        self._sequence, self._time = -1, -np.inf
        self._flushed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._ended = False

    async def admit(self, sequence: int) -> None:
        """Wait until there is room for a frame; raise InvalidRequestError where its sequence does not go up."""
        if sequence <= self._sequence:
            expected = (
                f"more than {self._sequence}, the last one to learn from: count up, or connect again to repeat frames"
            )
            raise invalid_request("sequence", sequence, expected)
        while len(self._waiting) >= 10 * self._most:  # blocks that wait; then the stream is read no further
            self._flushed.clear()
            await self._flushed.wait()

    def add(self, frame: Taught) -> None:
        """Gather a frame that was admitted and answered."""
        self._sequence = frame.sequence
        self._waiting.append(frame)
        if self._task is None and (self._timer is None or len(self._waiting) >= self._most):
            self._go_on()

    async def close(self) -> None:
        """Log what is left, which the client is not told any more."""
        self._ended = True
        self._go_on()
        while self._task is not None:
            await asyncio.wait((self._task,))

    def _go_on(self) -> None:
        """Log a block if it is time to, else look again when it is."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._task is not None or not self._waiting:
            return
        if self._due():
            self._task = asyncio.create_task(self._flush())
        else:
            left = self._waiting[0].arrived + self._wait - perf_counter()
            self._timer = asyncio.get_running_loop().call_later(left, self._go_on)

    def _due(self) -> bool:
        waiting = self._waiting
        if not waiting:
            return False
        return self._ended or len(waiting) >= self._most or perf_counter() - waiting[0].arrived >= self._wait

    async def _flush(self) -> None:
        try:
            while self._due():
                block = self._take()
                outcome = await self._learn(block)
                self._flushed.set()
                if not self._ended:
                    await self._send(json.dumps(outcome))
        finally:
            self._task = None
            self._go_on()

    def _take(self) -> list[Taught]:
        """Take the oldest frames, as many as are logged together: at most a block, all answered by one revision, and
        all with a load or all without."""
        waiting, (served, loaded, *_) = self._waiting, self._waiting[0]
        block: list[Taught] = []
        while waiting and len(block) < self._most:
            if waiting[0].served is not served or waiting[0].loaded is not loaded:
                break
            block.append(waiting.popleft())
        return block

    async def _learn(self, block: list[Taught]) -> dict[str, Any]:
        """Log a block; return what there is to say of it."""
        first, through = block[0].sequence, block[-1].sequence
        try:
            result = await self._learners.threads.run(
                block[0].served.name,
                lambda: self._learners.observe_frames(self._frames(block)),
                arrived=block[0].arrived,
            )
        except ServiceError as error:
            refusal = error
        except Exception as error:  # the next block may be logged
            known = translate_error(error)
            logger.error(
                "error while stream %r was learnt from: %s", self._stream_id, error, exc_info=None if known else error
            )
            refusal = known or ServiceError("an unexpected error; the service's log says more")
        else:
            return {"learnt": asdict(result)}
        if self._ended:
            logger.warning("frames %d to %d of stream %r are not learnt: %s", first, through, self._stream_id, refusal)
        body = ErrorBody(code=refusal.code, message=refusal.message, detail=refusal.detail)
        return {"refused": {"first": first, "through": through, "error": body.model_dump()}}

    def _frames(self, block: list[Taught]) -> Frames:
        served, loaded, *_ = block[0]
        sequences = np.array([each.sequence for each in block], np.int64)
        q, dq, ddq, tau = _columns([each.request[REQUEST.size :] for each in block], 4)
        mean, std = _columns([each.answer for each in block], 2)
        factor, time = np.array([each.factor for each in block]), self._times(block)
        return Frames(served.name, self._stream_id, served, sequences, time, q, dq, ddq, tau, mean, std, factor, loaded)

    def _times(self, block: list[Taught]) -> Array:
        """Times of arrival, Unix time in s, each later than the one before, unless the host's clock was set."""
        clock = time.time() - perf_counter()
        if abs(clock - self._clock) > MIN_STEP_S:
            self._clock, self._time = clock, -np.inf
        ticks = 1e-6 * np.arange(1, len(block) + 1)  # frames that come in one piece have one time of arrival
        arrived = np.array([each.arrived for each in block]) + self._clock
        times: Array = np.maximum.accumulate(np.maximum(arrived - ticks, self._time)) + ticks
        self._time = float(times[-1])
        return times


def _columns(rows: list[bytes], count: int) -> Array:
    """Numbers of N rows with `count` vectors each, as one array (count, N, n) of its own."""
    numbers = np.frombuffer(b"".join(rows), NUMBER).reshape(len(rows), count, -1)
    columns: Array = np.array(numbers.transpose(1, 0, 2), np.float64, order="C")
    return columns
