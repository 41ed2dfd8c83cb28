"""A worker of a Dask cluster: it joins, joins again after the scheduler was away, runs jobs, and leaves in order.

For each job it runs a training process, and ends that where it has to be: a thread of the worker could not be ended; a
process can, and ends with its worker. The rules are those of one machine, see `lifecycle`. The outcome is written to
the job's row: nothing of it travels. Needs the extra `cluster`.
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
from service.runtime.executors import GPU_SHARD, SHARD, placed
from service.runtime.process import Slot, training_place
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import lifecycle, worker
from service.training.lifecycle import Ended, Facts, Hand, Settler

T = TypeVar("T")
logger = logging.getLogger(__name__)

WATCH_S = 0.2
"""Seconds between two looks at the job's row."""
_one = threading.Lock()
_stopping = threading.Event()


class VersionsDifferError(RuntimeError):
    """The service and the worker are of different versions."""


def host(version: str, job: str) -> None:
    """Run a job on this worker, and then whatever else waits that it can run. version: of the service that asks. Work
    that others wait for is not left lying: the cluster gives tickets to workers before these are free."""
    if version != __version__:
        raise VersionsDifferError(f"the worker has version {__version__}, the service {version}: start them alike")
    with _one:  # a worker that has lost its scheduler and joined again may still be at work
        following: str | None = job
        while following is not None and not _stopping.is_set():
            hosting = _host()
            following = hosting.next() if hosting.run(following) else None


@cache
def _host() -> Host:
    """The host of this worker, whose training process stays for the next job: its start takes seconds."""
    settings = placed(None)
    return Host(settings, Database.of(settings), worker.run)


def stop(timeout_s: float) -> None:
    """End what runs and wait for that, for so many seconds at most: its job waits for another worker."""
    _stopping.set()
    if _one.acquire(timeout=timeout_s):
        _host().close()
        _one.release()


def has_gpu() -> bool:
    """Whether this worker has one, as it was told."""
    from distributed import get_worker  # noqa: PLC0415 - an extra

    return bool(get_worker().state.total_resources.get("GPU"))


class Host:
    """Runs one job after the other in a training process. function: what the process does with a job."""

    def __init__(self, settings: Settings, database: Database, function: Callable[[Settings, str], None]) -> None:
        self.settings, self.database, self.function = settings, database, function
        self.files = Files.of(settings)
        self.settler = Settler(database, self.files)
        place = training_place(settings)
        if settings.training_cpus is None:  # nothing is served here that a CPU is to be left to
            place = replace(place, cpus=None)
        self.slot = Slot(place)

    def close(self) -> None:
        """End the process, and the talk with the database."""
        self.slot.close()
        self.database.close()

    def next(self) -> str | None:
        """The job that has waited longest of those that this worker can run; None where there is none."""
        gpu = has_gpu()
        return self._patiently(lambda: self._oldest(gpu))

    def run(self, job: str) -> bool:
        """Run a job to its end, if it waits or whoever ran it is gone; return whether there may be more to do."""
        row = self._patiently(lambda: self._row(job))
        if row is not None and row.state == RUNNING:
            if self._lives(row):
                return True
            message = "the worker that ran it is gone"
            self._settle(Ended(job, "ended", message, row.attempts))
            row = self._patiently(lambda: self._row(job))
        if row is None or row.state != QUEUED:
            return True
        try:
            future = self.slot.start(self.function, self.settings, job)
        except OSError as error:
            self._settle(Ended(job, "ended", f"a training process could not be started: {error}"))
            return False
        return self._watch(Hand(job, self.slot, future, time.monotonic()), future, row.attempts + 1)

    def _watch(self, hand: Hand, future: Future[None], attempt: int) -> bool:
        while not wait([future], WATCH_S).done:
            if _stopping.is_set():
                self.slot.kill()
                self._patiently(lambda: self._hand_back(hand.job, attempt))
                return False
            try:
                row = self._row(hand.job)
            except Exception:  # without it the process cannot go on either, but it may come back
                logger.warning("the row of %s could not be read", hand.job, exc_info=True)
                continue
            clock = time.monotonic()
            if row is None or row.attempts > attempt or (hand.ran is not None and row.state == QUEUED):
                self.slot.kill()  # it is given to another one
                return True
            if row.attempts == attempt:
                hand.see(Facts(row.state, row.heartbeat_at, row.cancel_requested), clock)
            if (ended := hand.judge(self.settings, clock)) is not None:
                self.slot.kill()
                self._settle(Ended(hand.job, ended.why, ended.message, attempt))
                return ended.why != "not_started"
        error = future.exception()
        if error is None:  # written by the process, or not its to write
            return True
        ending = f"the training process {self.slot.ending()}" if isinstance(error, BrokenProcessPool) else str(error)
        self._settle(Ended(hand.job, "ended", ending, attempt))
        return hand.ran is not None

    def _lives(self, row: JobRow) -> bool:
        """Whether signs of life come from wherever a job runs; one that has ended meanwhile needs none."""
        end = time.monotonic() + 3.0  # a sign of life comes each half second
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

    def _hand_back(self, job: str, attempt: int) -> None:
        with self.database.transaction() as session:
            row = lifecycle.row_of(session, job)
            if row is None or row.state != RUNNING or row.attempts != attempt:
                return
            lifecycle.hand_back(row, "its worker was stopped while it ran")
        lifecycle.remove_leftovers(self.database, self.files, job)

    def _settle(self, ended: Ended) -> None:
        self._patiently(lambda: self.settler.settle(ended))

    def _patiently(self, ask: Callable[[], T]) -> T | None:
        """Ask the database until it answers, or the worker is to stop: then once more only."""
        while True:
            try:
                return ask()
            except Exception:
                logger.warning("the database could not be used: tried again", exc_info=True)
                if _stopping.wait(1.0):
                    return None


WRITE_S = 10.0
"""Longest wait in s for the database when a worker starts."""


class CannotJoinError(RuntimeError):
    """A worker lacks what it needs; the message says what."""


def check_storage(settings: Settings) -> None:
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
        joined = asyncio.create_task(_be_member(settings, scheduler, resources, name))
        await asyncio.wait({joined, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if stopped.is_set():
            await asyncio.to_thread(stop, 10.0)  # its job is handed back
            joined.cancel()
            with suppress(asyncio.CancelledError):
                await joined
            return
        if (error := joined.exception()) is not None:
            logger.warning("the cluster could not be joined: %s", error)
        logger.warning("the scheduler %s is gone: joined again once it is there", scheduler)
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), 2.0)


async def _be_member(settings: Settings, scheduler: str, resources: dict[str, float], name: str | None) -> None:
    """Be a member of the cluster until the scheduler is gone or this is cancelled."""
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it has set another one
    options = {"distributed.worker.profile.enabled": False, "distributed.worker.daemon": False}
    with dask.config.set(options):
        member = _Worker(
            scheduler,
            nthreads=2,  # one waits for the process of a job, one computes a shard
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
