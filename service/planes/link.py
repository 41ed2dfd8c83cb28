"""The data plane's end of the channel to the control plane."""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from pickle import PickleBuffer
from typing import Any

from service.api.access.keys import Keyring
from service.foundation.errors import NotReadyError, ServiceError
from service.foundation.settings import Settings
from service.learning.ingest.frames import Frames, FramesResult
from service.planes.channel import Channel
from service.planes.handover import adopt
from service.planes.published import PublishedModels

logger = logging.getLogger(__name__)
MAX_LOG_S, RESEND_S = 0.8, 0.02
"""Max seconds that frames wait for the control plane, less than a stream collects at 1 kHz; pause before they are sent
again."""


class ControlLink:
    """The data plane's end of the channel to the control plane. A thread receives and reconnects."""

    def __init__(self, settings: Settings, path: Path, keyring: Keyring | None) -> None:
        self.settings, self.keyring = settings, keyring
        self.loaded = PublishedModels(settings, self._request)
        self.published = threading.Event()
        self._path = path
        self._channel: Channel | None = None
        self._numbers, self._logging = itertools.count(), dict[int, asyncio.Future[Any]]()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._adopted: Callable[[bytes], Callable[[], asyncio.Protocol]] | None = None
        threading.Thread(target=self._run, daemon=True, name="control").start()

    def start(self, protocol: Callable[[bytes], Callable[[], asyncio.Protocol]]) -> None:
        """Begin to answer, in the running event loop. protocol: makes a connection that begins with bytes."""
        self._loop, self._adopted = asyncio.get_running_loop(), protocol

    def _request(self, model: str, version: int | None, alias: str | None) -> None:
        self._send(("load", model, version, alias))

    def pass_on(self, fd: int, data: bytes) -> bool:
        """Pass a connection on to the control plane; never waits."""
        return self._send(("connection", PickleBuffer(data)), [fd], wait=False)

    async def log_frames(self, model: str, make: Callable[[], Frames], arrived: float) -> FramesResult:
        """Let the control plane log frames; return its result once they are durable. Raise ServiceError."""
        frames, loop = make(), asyncio.get_running_loop()
        served, number = frames.served, next(self._numbers)
        sent: Any = Frames(**{**frames.__dict__, "served": None})
        message = ("frames", number, sent, served.version, served.revision)
        try:
            async with asyncio.timeout(MAX_LOG_S):
                while True:
                    self._logging[number] = done = loop.create_future()
                    if self._send(message, wait=False) and (result := await done) is not None:
                        break
                    await asyncio.sleep(RESEND_S)  # a new control plane knows the sequences that were logged
        except TimeoutError:
            raise _gone() from None
        finally:
            self._logging.pop(number, None)
        if isinstance(result, ServiceError):
            raise result
        return result  # type: ignore[no-any-return]

    def _send(self, message: Any, fds: Any = (), wait: bool = True) -> bool:
        channel = self._channel
        return channel is not None and channel.send(message, fds, wait)

    def _run(self) -> None:
        while True:
            try:
                self._channel = channel = Channel.connect(self._path)
            except OSError:
                time.sleep(0.05)
                continue
            for model in self.loaded.held():
                channel.send(("load", model, None, None))
            while (received := channel.receive()) is not None:
                try:
                    self._handle(*received)
                except Exception:
                    logger.exception("could not apply a publication")
            self._channel = None
            channel.close()
            self._on_loop(self._resend)

    def _handle(self, message: Any, fds: list[int]) -> None:
        if not isinstance(message, tuple):
            began = time.perf_counter()
            self.loaded.apply(message)
            logger.debug("applied %s in %.1f ms", type(message).__name__, 1e3 * (time.perf_counter() - began))
            return
        kind, *given = message
        if kind == "published":
            self.published.set()
        elif kind == "connection":
            assert self._adopted is not None
            assert self._loop is not None
            asyncio.run_coroutine_threadsafe(adopt(fds[0], self._adopted(bytes(given[0]))), self._loop)
        elif kind == "logged":
            self._on_loop(self._resolve, *given)
        elif kind == "keys" and self.keyring is not None:
            self.keyring._update_keys(given[0])
            self._on_loop(self.keyring._end_lasting)
            self.published.set()

    def _on_loop(self, call: Callable[..., None], *given: Any) -> None:
        if self._loop is not None:
            self._loop.call_soon_threadsafe(call, *given)

    def _resolve(self, number: int, result: Any) -> None:
        if (done := self._logging.get(number)) is not None and not done.done():
            done.set_result(result)

    def _resend(self) -> None:
        for done in self._logging.values():
            if not done.done():
                done.set_result(None)


def _gone() -> NotReadyError:
    return NotReadyError("The control plane of the service does not answer: nothing is learnt now.")
