"""The process of the data plane: it answers control loops and does nothing else."""

from __future__ import annotations

import asyncio
import fcntl
import gc
import logging
import os
import socket
import sys
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext
from functools import partial
from types import FrameType
from typing import Any

import uvicorn
from starlette.routing import BaseRoute
from threadpoolctl import threadpool_limits

from lipcore.posterior.threads import limit_threads
from service.api.access.keys import REFRESH_S, Keyring
from service.api.server import sockets
from service.api.server.configuration import configure_server
from service.api.server.connections import guarded
from service.api.server.sockets import UnixSocket
from service.foundation.settings import Settings
from service.planes.answers import DataApp, with_middleware
from service.planes.connections import DataProtocol, DataStream
from service.planes.inheritance import DATA_PARTS, Inheritance
from service.planes.link import ControlLink
from service.planes.pulse import BEAT_S, Plane, Pulse
from service.runtime import forking
from service.runtime.process import SERVING_THREADS
from service.runtime.realtime import RealTime, enter_real_time
from service.telemetry.meters import Meters
from service.telemetry.readiness import StopState

logger = logging.getLogger(__name__)
DRAIN_S = 2
"""Max wait for running requests when the data plane stops, s: they take milliseconds, and streams are closed."""


def run(inherited: Inheritance, part: int) -> None:
    """Follow the control plane; answer once no other data plane lives. part: of this process in the shared memory."""
    inherited.accepting.close()
    settings, shared = inherited.settings, inherited.memory.join(part)
    sys.setswitchinterval(3e-5)
    threadpool_limits(SERVING_THREADS)
    limit_threads(SERVING_THREADS)
    burst = settings.max_request_burst
    keyring = Keyring(REFRESH_S, burst, shared.counters, shared.buckets) if settings.keys_needed else None
    control, meters = ControlLink(settings, inherited.link, keyring), Meters(counters=shared.counters)
    routes = _routes_of_calls(settings)
    control.published.wait()
    held = os.open(f"/proc/self/fd/{inherited.lock}", os.O_RDWR)  # opened anew: a lock belongs to an opened file
    fcntl.flock(held, fcntl.LOCK_EX)
    forking.rename("data")
    for other in DATA_PARTS:
        if other != part:
            shared.counters.clear_gauges(other)
    app = DataApp(control.learners, meters, shared, routes)
    made: Any = guarded(
        settings, kind=DataProtocol, others=control.passed, passed=control.passed, control=control.pass_on
    )
    config = configure_server(
        with_middleware(app, settings, keyring, meters, shared),
        settings,
        http=made,
        ws=type("DataStream", (DataStream,), {"control": control.pass_on}),
        port=0,  # uvicorn then logs the port that the system has chosen
        lifespan="on" if settings.opentelemetry else "off",
        timeout_graceful_shutdown=DRAIN_S,
    )
    server = DataServer(config, inherited.unix, settings.stop_notice_s, inherited.pulse)
    server.when_started = lambda: control.start(
        partial(made, config=config, server_state=server.server_state, app_state=server.lifespan.state)
    )
    if routes:
        from service.planes.calls import serving_calls  # noqa: PLC0415 - of an extra, and only after the fork

        server.calls = serving_calls(app, settings, keyring, meters, shared, server.stopping)
    server.run([inherited.port])


def _log(granted: RealTime) -> None:
    """Log the granted scheduling policy and locked pages, and what to do about each refusal."""
    pages = "locked" if granted.pages_locked else "not locked"
    policy = f"{granted.policy} {granted.priority}" if granted.priority else granted.policy
    logger.info("control loops are answered by a thread of the scheduling policy %s; its pages are %s", policy, pages)
    for refusal in granted.refusals:
        logger.info("%s: %s", refusal.reason, refusal.remedy)


def _routes_of_calls(settings: Settings) -> list[BaseRoute]:
    """Return the routes of gRPC calls, if there are any."""
    if settings.grpc_port is None:
        return []
    import service.planes.calls  # noqa: F401, PLC0415 - of an extra; now, as it takes too long for a takeover
    from service.api.oip.rpc.methods import Methods  # noqa: PLC0415

    return [Methods()]


class DataServer(sockets.Server):
    """uvicorn's server on listeners that the supervisor has opened, with a heartbeat.

    calls: serves gRPC. when_started: called once it listens.
    """

    calls: AbstractAsyncContextManager[None] = nullcontext()
    when_started: Callable[[], None]

    def __init__(self, config: uvicorn.Config, unix: UnixSocket | None, notice_s: float, pulse: Pulse) -> None:
        super().__init__(config, unix, StopState(), notice_s)
        self._pulse = pulse

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await self.calls.__aenter__()
        await super().startup(sockets)
        self.when_started()
        if self._pulse.last_beat(Plane.DATA).pid:
            logger.warning("process %d is the data plane now", os.getpid())
        else:
            self._log_started_message(sockets or ())
        self._loop = asyncio.get_running_loop()
        gc.freeze()
        _log(enter_real_time())
        self._beat()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop; the file of the Unix-domain socket stays for the next data plane."""
        self.unix = None
        await super().shutdown(sockets)
        await self.calls.__aexit__(None, None, None)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop. A second signal changes nothing: the supervisor kills this process."""
        self.should_exit = True

    def _beat(self) -> None:
        self._pulse.beat(Plane.DATA)
        self._loop.call_later(BEAT_S, self._beat)
