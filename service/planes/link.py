"""The data plane's end of the channel to the control plane."""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from service.api.access.keys import Keyring
from service.foundation.settings import Settings
from service.planes.counting import ConnectionReport, ConnectionShed, PassedConnections
from service.planes.frames import FramesLogged, RemoteLearners
from service.planes.handover import Handed, adopt, pass_on
from service.planes.publications import KeysRead
from service.planes.published import PublishedModels
from service.runtime.channel import Channel
from service.runtime.realtime import PRIORITY, enter_real_time

logger = logging.getLogger(__name__)
RECONNECT_S = 0.05
"""Pause between two tries to connect, s."""
REPORT_S = 1.0
"""Seconds between two reports of the versions that are used, and two checks of the keys of streams."""


class ControlLink:
    """The data plane's end of the channel to the control plane. A thread receives and reconnects.

    - loaded: the versions that the control plane has published; published: set after the first publication.
    - learners: logs frames of streams; passed: the connections that were passed on.
    """

    def __init__(self, settings: Settings, path: Path, keyring: Keyring | None) -> None:
        self.settings, self.keyring = settings, keyring
        self.loaded = PublishedModels(settings, self._send_at_once)
        self.published = self.loaded.ready
        self.learners = RemoteLearners(settings, self.loaded, self._send_at_once)
        self.passed = PassedConnections(self._send_at_once)
        self._path, self._closed = path, False
        self._channel: Channel | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._protocol: Callable[..., asyncio.Protocol] | None = None
        threading.Thread(target=self._run, daemon=True, name="control").start()

    def start(self, protocol: Callable[..., asyncio.Protocol]) -> None:
        """Begin to answer, in the running event loop. protocol: returns a `DataProtocol`; its argument is `handed`."""
        self._protocol = protocol
        self._loop = asyncio.get_running_loop()
        self.loaded.begin_answering()
        self._report()

    def _report(self) -> None:
        """Report each second which versions are used, and end the streams of invalid keys."""
        self.loaded.report_use()
        if self.keyring is not None:
            self.keyring.end_lasting()
        assert self._loop is not None
        self._loop.call_later(REPORT_S, self._report)

    @property
    def is_connected(self) -> bool:
        """Whether there is a control plane."""
        return self._channel is not None

    def close(self) -> None:
        """Close the channel for good."""
        self._closed = True
        if (channel := self._channel) is not None:
            channel.close()

    def pass_on(self, transport: asyncio.Transport, handed: Handed, peer: str | None) -> bool:
        """Pass a connection to the control plane, see `PassOn`."""
        number = self.passed.number(peer)
        passed = pass_on(transport, handed, partial(self._send_connection, number))
        if not passed:
            self.passed.forget(number)
        return passed

    def _send_connection(self, number: int, fd: int, handed: Handed) -> bool:
        message = Handed(handed.data, handed.counted, handed.refused, number)
        return self._send(message, [fd], wait=False)

    def _send_at_once(self, message: Any) -> bool:
        return self._send(message, wait=False)

    def _send(self, message: Any, fds: Any = (), wait: bool = True) -> bool:
        channel = self._channel
        return channel is not None and channel.send(message, fds, wait)

    def _run(self) -> None:
        # the event loop waits for this thread when it needs Python's lock: other processes must not interrupt it
        enter_real_time(PRIORITY - 1, lock_pages=False)
        while not self._closed:
            try:
                self._channel = channel = Channel.connect(self._path)
            except OSError:
                time.sleep(RECONNECT_S)
                continue
            channel.send(self.loaded.start_connection())
            while (received := channel.receive()) is not None:
                try:
                    self._handle(*received)
                except Exception:
                    logger.exception("could not apply a publication; the data plane connects again")
                    break
            self._channel = None
            channel.close()
            self._on_loop(self.learners.resend)
            self._on_loop(self.passed.clear)

    def _handle(self, message: Any, fds: list[int]) -> None:
        match message:
            case Handed():
                self._adopt(message, fds[0])
            case FramesLogged():
                self._on_loop(self.learners.receive, message)
            case ConnectionReport():
                self._on_loop(self.passed.update, message)
            case ConnectionShed():
                self._on_loop(self.passed.receive, message)
            case KeysRead(keys) if self.keyring is not None:
                self.keyring.update(keys)
                self._on_loop(self.keyring.end_lasting)
            case _:
                began = time.perf_counter()
                self.loaded.apply(message)
                logger.debug("applied %s in %.1f ms", type(message).__name__, 1e3 * (time.perf_counter() - began))

    def _adopt(self, handed: Handed, fd: int) -> None:
        if self._loop is None or self._protocol is None:
            os.close(fd)
        else:
            asyncio.run_coroutine_threadsafe(adopt(fd, partial(self._protocol, handed=handed)), self._loop)

    def _on_loop(self, call: Callable[..., None], *given: Any) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # closed: this process ends
                self._loop.call_soon_threadsafe(call, *given)
