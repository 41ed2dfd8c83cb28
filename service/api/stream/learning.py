"""Learning from the frames of a stream: frames with measured torque are collected and logged in blocks."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import numpy as np

from lipcore.data.samples import Array
from service.api.errors import UNEXPECTED_ERROR
from service.contract.frames import NUMBER, REQUEST
from service.foundation.errors import ErrorBody, ServiceError, invalid_request
from service.foundation.settings import Settings
from service.learning.ingest.clock import MIN_STEP_S
from service.learning.ingest.frames import Frames, FramesResult
from service.models.served import AnsweringModels, ServedModel
from service.storage.errors import translate_error

logger = logging.getLogger(__name__)
MAX_WAITING_BLOCKS = 40
"""Max blocks of frames that wait to be logged: those of four seconds at 1 kHz. Then the stream is not read."""


class LearningFrame(NamedTuple):
    """A frame to learn from, with its prediction."""

    served: ServedModel
    """The revision that answered."""
    loaded: bool
    """Whether the prediction includes a payload."""
    sequence: int
    arrived: float
    """Time of arrival by `time.perf_counter`, s."""
    request: bytes
    """The whole frame."""
    answer: bytes
    """Posterior mean and standard deviation, (2, n), before the frame was learnt."""
    factor: Array
    """Factor on the half width of the interval, (n,)."""


class StreamLearners(Protocol):
    """The learners of the service as streams need them: `Learners`, or its end in another process."""

    @property
    def settings(self) -> Settings:
        """The settings of the service."""
        ...

    @property
    def loaded(self) -> AnsweringModels:
        """The versions in memory."""
        ...

    async def log_frames(self, model: str, make: Callable[[], Frames], arrived: float) -> FramesResult:
        """Log the frames that `make` returns; return once they are durable.

        arrived: time at which the first frame arrived, by `time.perf_counter`. Raise ServiceError.
        """
        ...


class FrameLearning:
    """Logs the frames of one connection in blocks, one at a time and in order, while later frames wait.

    `send` sends a text to the client. Use it in the event loop; blocks are logged in a thread.
    """

    def __init__(self, learners: StreamLearners, stream_id: str, send: Callable[[str], Awaitable[None]]) -> None:
        self._learners, self._stream_id, self._send = learners, stream_id, send
        self._block_rows, self._max_wait_s = learners.settings.stream_flush_rows, learners.settings.stream_flush_s
        self._clock = time.time() - perf_counter()
        self._waiting: deque[LearningFrame] = deque()
        self._sequence, self._time = -1, -np.inf
        self._flushed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._ended = False

    async def admit(self, sequence: int) -> None:
        """Wait until there is room for a frame; raise InvalidRequestError if its sequence does not increase."""
        if sequence <= self._sequence:
            expected = f"more than {self._sequence}, that of the last frame to learn from: count up, or reconnect"
            raise invalid_request("sequence", sequence, expected)
        while len(self._waiting) >= MAX_WAITING_BLOCKS * self._block_rows:  # meanwhile the stream is not read
            self._flushed.clear()
            await self._flushed.wait()

    def add(self, frame: LearningFrame) -> None:
        """Add a frame that was admitted and answered."""
        self._sequence = frame.sequence
        self._waiting.append(frame)
        if self._task is None and (self._timer is None or len(self._waiting) >= self._block_rows):
            self._schedule()

    async def close(self) -> None:
        """Log the remaining frames, without sending the result to the client."""
        self._ended = True
        self._schedule()
        while self._task is not None:
            await asyncio.wait((self._task,))

    def _schedule(self) -> None:
        """Log a block if one is due, else set a timer for it."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._task is not None or not self._waiting:
            return
        if self._is_due():
            self._task = asyncio.create_task(self._flush())
        else:
            left = self._waiting[0].arrived + self._max_wait_s - perf_counter()
            self._timer = asyncio.get_running_loop().call_later(left, self._schedule)

    def _is_due(self) -> bool:
        waiting = self._waiting
        if not waiting:
            return False
        return (
            self._ended or len(waiting) >= self._block_rows or perf_counter() - waiting[0].arrived >= self._max_wait_s
        )

    async def _flush(self) -> None:
        try:
            while self._is_due():
                block = self._take_block()
                outcome = await self._learn(block)
                self._flushed.set()
                if not self._ended:
                    await self._send(json.dumps(outcome))
        finally:
            self._task = None
            self._schedule()

    def _take_block(self) -> list[LearningFrame]:
        """Remove and return the oldest block: frames of one revision, either all with or all without a payload."""
        waiting, (served, loaded, *_) = self._waiting, self._waiting[0]
        block: list[LearningFrame] = []
        while waiting and len(block) < self._block_rows:
            if waiting[0].served is not served or waiting[0].loaded is not loaded:
                break
            block.append(waiting.popleft())
        return block

    async def _learn(self, block: list[LearningFrame]) -> dict[str, Any]:
        """Log a block; return the message for the client."""
        first, through = block[0].sequence, block[-1].sequence
        try:
            result = await self._learners.log_frames(
                block[0].served.name, lambda: self._frames(block), block[0].arrived
            )
        except Exception as error:  # later blocks may succeed
            refusal = refusal_of(error, self._stream_id)
        else:
            return {"learnt": asdict(result)}
        if self._ended:
            logger.warning("frames %d to %d of stream %r were not learnt: %s", first, through, self._stream_id, refusal)
        body = ErrorBody(code=refusal.code, message=refusal.message, detail=refusal.detail)
        return {"refused": {"first": first, "through": through, "error": body.model_dump()}}

    def _frames(self, block: list[LearningFrame]) -> Frames:
        served, loaded, *_ = block[0]
        sequences = np.array([each.sequence for each in block], np.int64)
        q, dq, ddq, tau = _columns([each.request[REQUEST.size :] for each in block], 4)
        mean, std = _columns([each.answer for each in block], 2)
        factor, time = np.array([each.factor for each in block]), self._times(block)
        return Frames(served.name, self._stream_id, served, sequences, time, q, dq, ddq, tau, mean, std, factor, loaded)

    def _times(self, block: list[LearningFrame]) -> Array:
        """Return increasing times of arrival, Unix times in s. They only decrease if the host's clock was set."""
        clock = time.time() - perf_counter()
        if abs(clock - self._clock) > MIN_STEP_S:
            self._clock, self._time = clock, -np.inf
        ticks = 1e-6 * np.arange(1, len(block) + 1)  # frames received together have the same time of arrival
        arrived = np.array([each.arrived for each in block]) + self._clock
        times: Array = np.maximum.accumulate(np.maximum(arrived - ticks, self._time)) + ticks
        self._time = float(times[-1])
        return times


def refusal_of(error: Exception, stream_id: str) -> ServiceError:
    """Return the error for a client whose frames could not be logged; log one that is not the client's."""
    if isinstance(error, ServiceError):
        return error
    known = translate_error(error)
    logger.error("frames of stream %r could not be learnt: %s", stream_id, error, exc_info=None if known else error)
    return known or ServiceError(UNEXPECTED_ERROR)


def _columns(rows: list[bytes], count: int) -> Array:
    """Return a new array (count, N, n) of the numbers of N rows with `count` vectors each."""
    numbers = np.frombuffer(b"".join(rows), NUMBER).reshape(len(rows), count, -1)
    columns: Array = np.array(numbers.transpose(1, 0, 2), np.float64, order="C")
    return columns
