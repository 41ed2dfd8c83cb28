"""The process of the data plane: it answers control loops and does nothing else."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import sys
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext
from functools import partial
from pathlib import Path
from struct import Struct
from typing import Any

import uvicorn
from starlette.routing import BaseRoute
from threadpoolctl import threadpool_limits

from service.api.access.keys import REFRESH_S, Keyring
from service.api.server import sockets
from service.api.server.connections import MAX_FRAME_BYTES, guarded
from service.api.shared import SharedMemory
from service.foundation.settings import Settings
from service.planes.answers import DataApp, with_middleware
from service.planes.connections import DataProtocol, DataStream
from service.planes.link import ControlLink
from service.runtime.process import SERVING_THREADS
from service.telemetry.meters import Meters
from service.telemetry.readiness import StopState

logger = logging.getLogger(__name__)
BEAT = Struct("<QQ")
"""Process of the data plane, and a number that it counts up."""
BEAT_S = 0.05
CONTROL_PART, DATA_PARTS = 0, {1, 2}
"""Parts of the shared memory: of the control plane, and of the data plane and its spare."""


def run(settings: Settings, listener: Any, link: Path, lock: Path, beats: Any, memory: SharedMemory, part: int) -> None:
    """Follow the control plane; answer once no other data plane lives. part: that of this process in `memory`."""
    shared = memory.join(part)
    sys.setswitchinterval(3e-5)
    threadpool_limits(SERVING_THREADS)
    from lipcore.posterior.threads import limit_threads  # noqa: PLC0415 - the numerics

    limit_threads(SERVING_THREADS)
    burst = settings.max_request_burst
    keyring = Keyring(REFRESH_S, burst, shared.counters, shared.buckets) if settings.keys_needed else None
    control, meters = ControlLink(settings, link, keyring), Meters(counters=shared.counters)
    further = _routes_of_calls(settings)
    control.published.wait()
    held = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(held, fcntl.LOCK_EX)  # the kernel frees it the moment the process that held it is gone
    logger.info("process %d is the data plane", os.getpid())
    for other in DATA_PARTS - {part}:
        shared.counters.clear_gauges(other)
    app = DataApp(control.learners, meters, shared, further)
    made: Any = guarded(settings, kind=DataProtocol, others=control.passed, control=control.pass_on)
    config = uvicorn.Config(
        with_middleware(app, settings, keyring, meters, shared),
        log_config=None,
        access_log=False,
        loop="uvloop",
        http=made,
        ws=type("DataStream", (DataStream,), {"control": control.pass_on}),
        ws_max_size=MAX_FRAME_BYTES,
        ws_per_message_deflate=False,
        timeout_keep_alive=settings.keep_alive_s,
        timeout_graceful_shutdown=sockets.DRAIN_S,
        forwarded_allow_ips=settings.trusted_proxies,
        lifespan="off",
    )
    server = _Server(config, None, StopState(), settings.stop_notice_s)

    def begin() -> None:
        control.start(partial(made, config=config, server_state=server.server_state, app_state=server.lifespan.state))
        beat(1)

    def beat(number: int) -> None:
        BEAT.pack_into(beats, 0, os.getpid(), number)
        asyncio.get_running_loop().call_later(BEAT_S, beat, number + 1)

    if further:
        from service.planes.calls import serving_calls  # noqa: PLC0415 - of an extra, and only after the fork

        server.calls = serving_calls(app, settings, keyring, meters, shared, server.stopping)
    server.begun = begin
    server.run([listener])


def _routes_of_calls(settings: Settings) -> list[BaseRoute]:
    """Return the routes of gRPC calls, if there are any."""
    if settings.grpc_port is None:
        return []
    from service.api.oip.rpc.methods import Methods  # noqa: PLC0415

    return [Methods()]


class _Server(sockets.Server):
    begun: Callable[[], None]
    calls: AbstractAsyncContextManager[None] = nullcontext()

    async def startup(self, sockets: Any = None) -> None:
        await self.calls.__aenter__()
        await super().startup(sockets)
        self.begun()

    async def shutdown(self, sockets: Any = None) -> None:
        await super().shutdown(sockets)
        await self.calls.__aexit__(None, None, None)
