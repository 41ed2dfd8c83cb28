"""A worker of a Dask cluster: join, rejoin after the scheduler was away, run jobs, and leave in order.

A job runs in a training process, which the worker kills if it must end; a thread could not be killed. The process also
ends with its worker. The rules are those of a single machine, see `lifecycle`. The outcome is written to the job's row
and not sent over the cluster. Needs the extra `cluster`.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import dask
import distributed
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service import __version__
from service.contract.states import ACTIVE, QUEUED, RUNNING
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings
from service.runtime import executors
from service.runtime.cluster import GPU, JOB, needs_gpu
from service.runtime.executors import GPU_SHARD, SHARD, choose_settings
from service.runtime.process import Slot, training_process_options
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import lifecycle, texts, worker
from service.training.lifecycle import JobEnd, JobStatus, Settler, WatchedJob

T = TypeVar("T")
logger = logging.getLogger(__name__)

WATCH_S = 0.2
"""Interval between two reads of the job's row, s."""
_one = threading.Lock()
_stopping = threading.Event()


class VersionsDifferError(RuntimeError):
    """The service and the worker have different versions."""


def host(version: str, job: str) -> None:
    """Run a job on this worker, then further waiting jobs that it can run.

    `version` is the version of the calling service. The loop is necessary because the cluster assigns jobs to workers
    that are not free yet.
    """
    if version != __version__:
        raise VersionsDifferError(f"the worker has version {__version__}, the service {version}: install the same one")
    with _one:  # a worker that lost its scheduler and rejoined may still run a job
        following: str | None = job
        while following is not None and not _stopping.is_set():
            hosting = _host()
            following = hosting.next() if hosting.run(following) else None


@cache
def _host() -> Host:
    """Return the host of this worker. It keeps its training process for the next job, as a start takes seconds."""
    settings = choose_settings(None)
    return Host(settings, Database.of(settings), worker.run)


def stop(timeout_s: float) -> None:
    """Stop the running job and wait at most `timeout_s`; the job waits for another worker."""
    _stopping.set()
    if _one.acquire(timeout=timeout_s):
        _host().close()
        _one.release()


def has_gpu() -> bool:
    """Return whether this worker was started with a GPU."""
    from distributed import get_worker  # noqa: PLC0415 - an extra

    return bool(get_worker().state.total_resources.get("GPU"))


class Host:
    """Runs one job after another in a training process, which calls `function` with each."""

    def __init__(self, settings: Settings, database: Database, function: Callable[[Settings, str], None]) -> None:
        self.settings, self.database, self.function = settings, database, function
        self.files = Files.of(settings)
        self.settler = Settler(database, self.files)
        place = training_process_options(settings)
        if settings.training_cpus is None:  # a worker serves no queries, so no CPU is reserved
            place = replace(place, cpus=None)
        self.slot = Slot(place)

    def close(self) -> None:
        """Stop the process and close the database."""
        self.slot.close()
        self.database.close()

    def next(self) -> str | None:
        """Return the longest-waiting job that this worker can run; None if there is none."""
        gpu = has_gpu()
        return self._patiently(lambda: self._oldest(gpu))

    def run(self, job: str) -> bool:
        """Run a job to its end if it waits or its process is gone; return whether to look for another job."""
        row = self._patiently(lambda: self._row(job))
        if row is not None and row.state == RUNNING:
            if self._lives(row):
                return True
            self._settle(JobEnd(job, "ended", texts.WORKER_GONE, row.attempts))
            row = self._patiently(lambda: self._row(job))
        if row is None or row.state != QUEUED:
            return True
        try:
            future = self.slot.start(self.function, self.settings, job)
        except OSError as error:
            self._settle(JobEnd(job, "ended", texts.describe_start_failure(error)))
            return False
        return self._watch(WatchedJob(job, self.slot, future, time.monotonic()), future, row.attempts + 1)

    def _watch(self, watched: WatchedJob, future: Future[None], attempt: int) -> bool:
        while not wait([future], WATCH_S).done:
            if _stopping.is_set():
                self.slot.kill()
                self._patiently(lambda: self._requeue(watched.job, attempt))
                return False
            try:
                row = self._row(watched.job)
            except Exception:  # the process needs the database too, but it may become available again
                logger.warning("could not read the row of %s", watched.job, exc_info=True)
                continue
            clock = time.monotonic()
            if row is None or row.attempts > attempt or (watched.ran is not None and row.state == QUEUED):
                self.slot.kill()  # another attempt has the job
                return True
            if row.attempts == attempt:
                watched.update(JobStatus(row.state, row.heartbeat_at, row.cancel_requested), clock)
            if (end := watched.judge(self.settings, clock)) is not None:
                self.slot.kill()
                self._settle(JobEnd(watched.job, end.why, end.message, attempt))
                return end.why != "not_started"
        error = future.exception()
        if error is None:  # the process wrote the outcome, or another attempt has the job
            return True
        ending = f"the training process {self.slot.ending()}" if isinstance(error, BrokenProcessPool) else str(error)
        self._settle(JobEnd(watched.job, "ended", ending, attempt))
        return watched.ran is not None

    def _lives(self, row: JobRow) -> bool:
        """Return whether a running job still sends heartbeats, or has ended meanwhile."""
        end = time.monotonic() + 3.0  # heartbeats arrive every half second
        while time.monotonic() < end and not _stopping.wait(WATCH_S):
            seen = self._patiently(lambda: self._row(row.id))
            if seen is None or seen.state not in ACTIVE or seen.heartbeat_at != row.heartbeat_at:
                return True
        return _stopping.is_set()

    def _oldest(self, gpu: bool) -> str | None:
        waiting = select(JobRow.id, JobRow.request).where(JobRow.state == QUEUED, JobRow.cancel_requested.is_(False))
        with self.database.session() as session:
            rows = session.execute(waiting.order_by(JobRow.seq)).all()
        return next((job for job, request in rows if gpu or not needs_gpu(request)), None)

    def _row(self, job: str) -> JobRow | None:
        with self.database.session() as session:
            return lifecycle.row_of(session, job)

    def _requeue(self, job: str, attempt: int) -> None:
        with self.database.transaction() as session:
            row = lifecycle.row_of(session, job)
            if row is None or row.state != RUNNING or row.attempts != attempt:
                return
            lifecycle.requeue(row, texts.WORKER_STOPPED)
        lifecycle.remove_leftovers(self.database, self.files, job)

    def _settle(self, end: JobEnd) -> None:
        self._patiently(lambda: self.settler.settle(end))

    def _patiently(self, ask: Callable[[], T]) -> T | None:
        """Retry a database call until it succeeds; once the worker stops, give up after one more try."""
        while True:
            try:
                return ask()
            except Exception:
                logger.warning("the database is unavailable; retrying", exc_info=True)
                if _stopping.wait(1.0):
                    return None


WRITE_S = 10.0
"""Maximum wait for the database when a worker starts, s."""


class CannotJoinError(RuntimeError):
    """A worker lacks a requirement, which the message names."""


def check_storage(settings: Settings) -> None:
    """Check that the database and the files can be used before the worker joins; raise CannotJoinError."""
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
    """Run as a worker until SIGTERM or SIGINT.

    `gpus` is the number of its GPUs, `name` its name in the cluster; the default is its address.
    """
    assert settings.cluster is not None
    executors.set_worker_settings(settings)
    resources: dict[str, float] = {JOB: 1, SHARD: 1, **({GPU: gpus, GPU_SHARD: gpus} if gpus else {})}
    asyncio.run(_work(settings, settings.cluster, resources, name))


class _Worker(distributed.Worker):
    async def close(self, *given: Any, **options: Any) -> Any:  # job threads end on their own
        return await super().close(*given, **{**options, "executor_wait": False})


async def _work(settings: Settings, scheduler: str, resources: dict[str, float], name: str | None) -> None:
    """Run as a worker until stopped; running jobs continue while the scheduler is away."""
    stopped = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    stopping = asyncio.create_task(stopped.wait())
    while not stopped.is_set():
        joined = asyncio.create_task(_run_worker(settings, scheduler, resources, name))
        await asyncio.wait({joined, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if stopped.is_set():
            await asyncio.to_thread(stop, 10.0)  # the job waits for another worker
            joined.cancel()
            with suppress(asyncio.CancelledError):
                await joined
            return
        if (error := joined.exception()) is not None:
            logger.warning("could not join the cluster: %s", error)
        logger.warning("lost the scheduler %s; joining again when it is back", scheduler)
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), 2.0)


async def _run_worker(settings: Settings, scheduler: str, resources: dict[str, float], name: str | None) -> None:
    """Stay in the cluster until the scheduler is gone or this task is cancelled."""
    logging.getLogger("distributed").setLevel(logging.WARNING)  # its import set another level
    options = {"distributed.worker.profile.enabled": False, "distributed.worker.daemon": False}
    with dask.config.set(options):
        member = _Worker(
            scheduler,
            nthreads=2,  # one thread waits for a job's process, one computes shards
            resources=resources,
            name=name,
            memory_limit=0,  # results are small, and the container has its own limit
            local_directory=str(settings.home / "dask"),
        )
        try:
            await member
            logger.info("worker %s has joined %s with %s", member.name, scheduler, resources)
            finished: Any = member.finished  # its module is only partly typed
            await finished()
        finally:
            await member.close(timeout=2)
