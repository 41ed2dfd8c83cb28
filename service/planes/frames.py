"""Frames to learn from: streams of the data plane send them to the control plane, which logs them."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any, cast

from service.api.stream.learning import refusal_of
from service.foundation.errors import NotReadyError, ServiceError
from service.foundation.settings import Settings
from service.learning.ingest.frames import Frames, FramesResult
from service.learning.learners import Learners
from service.models.served import AnsweringModels

MAX_WAIT_S = 2.0
"""Max wait of frames for the control plane, s: a restart takes less, and a stream of 1 kHz is read for twice as
long."""
MAX_FURTHER_WAIT_S = 0.02
"""The same while it has not answered since earlier frames were refused: a stream is not read less often for it."""
RESEND_S = 0.01
"""Pause before frames are sent again, s."""


@dataclass(frozen=True)
class FramesToLog:
    """Frames that the control plane shall log."""

    number: int
    frames: Frames
    """The frames, without the version."""
    version: int
    revision: int
    arrived: float
    """Time at which the first one arrived, by `time.perf_counter`, which all processes share on Linux."""
    until: float
    """Time by `time.monotonic` after which they are not logged: the client was told that they may be lost."""


@dataclass(frozen=True)
class FramesLogged:
    """The result of frames: they are durable, or were refused."""

    number: int
    result: FramesResult | ServiceError


class RemoteLearners:
    """The learners of the control plane, as streams of the data plane use them. Use it in the event loop.

    send: sends a message to the control plane without waiting; it returns whether it was sent.
    """

    def __init__(self, settings: Settings, loaded: AnsweringModels, send: Callable[[Any], bool]) -> None:
        self.settings, self.loaded, self._send = settings, loaded, send
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[FramesResult | ServiceError | None]] = {}
        self._silent = False  # since frames were refused

    async def log_frames(self, model: str, make: Callable[[], Frames], arrived: float) -> FramesResult:
        """Let the control plane log frames; return its result once they are durable. Raise ServiceError.

        They are sent again to a control plane that was started meanwhile: it knows which sequences were logged.
        """
        frames, loop, number = make(), asyncio.get_running_loop(), next(self._numbers)
        patience = MAX_FURTHER_WAIT_S if self._silent else MAX_WAIT_S
        served, until, without = frames.served, monotonic() + patience, cast(Any, None)
        message = FramesToLog(number, replace(frames, served=without), served.version, served.revision, arrived, until)
        result: FramesResult | ServiceError | None = None
        try:
            async with asyncio.timeout(patience):
                while result is None:
                    self._waiting[number] = done = loop.create_future()
                    if self._send(message):
                        result = await done
                    if result is None:
                        await asyncio.sleep(RESEND_S)
        except TimeoutError:
            self._silent = True
            raise frames_lost() from None
        finally:
            self._waiting.pop(number, None)
        if isinstance(result, ServiceError):
            raise result
        return result

    def receive(self, message: FramesLogged) -> None:
        """Pass a result to the stream that waits for it, if any still does."""
        self._silent = False
        if (done := self._waiting.get(message.number)) is not None and not done.done():
            done.set_result(message.result)

    def resend(self) -> None:
        """Send all frames again that wait: the control plane has ended."""
        for done in self._waiting.values():
            if not done.done():
                done.set_result(None)


async def log_frames(learners: Learners, message: FramesToLog) -> FramesLogged:
    """Log frames in the control plane; return once they are durable or refused."""
    frames = message.frames
    try:
        if monotonic() > message.until:
            raise frames_lost()
        served = learners.loaded.hot(frames.model, message.version)
        if served is None:
            served = await asyncio.to_thread(learners.loaded.get, frames.model, message.version)
        if served.revision != message.revision:
            served = replace(served, revision=message.revision)
        given = replace(frames, served=served)
        return FramesLogged(
            message.number, await learners.log_frames(frames.model, lambda: given, arrived=message.arrived)
        )
    except Exception as error:
        return FramesLogged(message.number, refusal_of(error, frames.stream_id))


def frames_lost() -> NotReadyError:
    """Return the error for a client whose frames the control plane has not acknowledged in time."""
    return NotReadyError(
        "The part of the service that learns does not answer now. Torques are still answered. It is unknown whether "
        "these frames are stored: reconnect and send them again with the same sequences. Stored frames are then "
        "counted as duplicates."
    )
