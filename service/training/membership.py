"""A worker's membership in a Dask cluster: it joins, joins again after the scheduler was away, and leaves in order.

Whatever uses it needs the extra `cluster`.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from contextlib import suppress
from typing import Any

import dask
import distributed
from sqlalchemy.exc import SQLAlchemyError

from service.compute import executors
from service.compute.cluster import GPU, JOB
from service.compute.executors import GPU_SHARD, SHARD
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.files import Files
from service.training import hosting

logger = logging.getLogger(__name__)

THREADS = 2
"""Of a worker: one waits for the process of a job, one computes a shard."""
AGAIN_S = 2.0
"""Seconds after which a worker that has lost its scheduler tries to join again."""
STOP_S = 10.0
"""Longest wait in s for the end of a job when a worker stops: it is handed back."""
WRITE_S = 10.0
"""Longest wait in s for the database when a worker starts."""


class CannotJoinError(RuntimeError):
    """A worker lacks what it needs; the message says what."""


def check(settings: Settings) -> None:
    """See that the database and the files can be used, before anything is asked of a worker. Raise CannotJoinError."""
    try:
        settings.home.mkdir(parents=True, exist_ok=True)
        database = Database.of(settings, WRITE_S)
        try:
            database.adapter.check(WRITE_S)
        finally:
            database.close()
        Files.of(settings).try_out()
    except (OSError, RuntimeError, SQLAlchemyError, ServiceError) as error:
        raise CannotJoinError(f"the worker cannot start: {getattr(error, 'orig', None) or error}") from None


def join(settings: Settings, gpus: int = 0, name: str | None = None) -> None:
    """Be a worker until SIGTERM or SIGINT. gpus: that it has; name: in the cluster, its address where None."""
    assert settings.cluster is not None
    executors.place(settings)
    resources: dict[str, float] = {JOB: 1, SHARD: 1, **({GPU: gpus, GPU_SHARD: gpus} if gpus else {})}
    asyncio.run(_work(settings, settings.cluster, resources, name))


class _Worker(distributed.Worker):
    async def close(self, *given: Any, **options: Any) -> Any:  # threads of jobs see to their end themselves
        return await super().close(*given, **{**options, "executor_wait": False})


async def _work(settings: Settings, scheduler: str, resources: dict[str, float], name: str | None) -> None:
    """Be a worker until told to stop; what runs goes on while the scheduler is away."""
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    stopping = asyncio.create_task(stopped.wait())
    while not stopped.is_set():
        joined = asyncio.create_task(_join(settings, scheduler, resources, name))
        await asyncio.wait({joined, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if stopped.is_set():
            await asyncio.to_thread(hosting.stop, STOP_S)
            joined.cancel()
            with suppress(asyncio.CancelledError):
                await joined
            return
        if (error := joined.exception()) is not None:
            logger.warning("the cluster could not be joined: %s", error)
        logger.warning("the scheduler %s is gone: joined again once it is there", scheduler)
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), AGAIN_S)


async def _join(settings: Settings, scheduler: str, resources: dict[str, float], name: str | None) -> None:
    """Be a member of the cluster until the scheduler is gone or this is cancelled."""
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it has set another one
    options = {"distributed.worker.profile.enabled": False, "distributed.worker.daemon": False}
    with dask.config.set(options):
        member = _Worker(
            scheduler,
            nthreads=THREADS,
            resources=resources,
            name=name,
            memory_limit=0,  # results are few; a container's limit is the one that counts
            local_directory=str(settings.home / "dask"),
        )
        try:
            await member
            logger.info("worker %s has joined %s with %s", member.name, scheduler, resources)
            finished: Any = member.finished  # its module is typed in part
            await finished()
        finally:
            await member.close(timeout=2)
