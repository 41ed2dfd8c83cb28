"""What a worker of the cluster does with a job: run a training process for it, and end that where it has to be.

A thread of the worker could not be ended; a process can, and ends with its worker. The rules are those of one machine,
see `watch`. The outcome is written to the job's row: nothing of it travels.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

from sqlalchemy import select

from service import __version__
from service.compute.executors import placed
from service.compute.process import training_place
from service.foundation.settings import Settings
from service.foundation.states import ACTIVE, CANCELLED, QUEUED, RUNNING
from service.storage.database import Database, JobRow
from service.storage.files import Files
from service.training import history, leftovers, worker
from service.training.settling import Settler
from service.training.slots import Slot
from service.training.watch import Ended, Facts, Hand

T = TypeVar("T")
logger = logging.getLogger(__name__)

WATCH_S = 0.2
"""Seconds between two looks at the job's row."""
SILENCE_S = 3.0
"""Seconds without a sign of life, one of which comes each half second, after which the worker of a job is gone."""
AGAIN_S = 1.0
"""Seconds after which the database is tried again."""
_one = threading.Lock()
_stopping = threading.Event()


class VersionsDifferError(RuntimeError):
    """The service and the worker are of different versions."""


def needs_gpu(request: dict[str, Any]) -> bool:
    """Whether a job has to run on a worker with a GPU."""
    return bool(request.get("options", {}).get("device") == "cuda")


def host(version: str, job: str) -> None:
    """Run a job on this worker, and then whatever else waits that it can run. version: of the service that asks.

    Work that others wait for is not left lying: the cluster gives tickets to workers before these are free.
    """
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
        self.settler = Settler(settings, database, self.files)
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
                logger.warning("the row of job %s could not be read", hand.job, exc_info=True)
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
        end = time.monotonic() + SILENCE_S
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
            found: JobRow | None = session.scalar(select(JobRow).where(JobRow.id == job))
        return found

    def _hand_back(self, job: str, attempt: int) -> None:
        with self.database.transaction() as session:
            row = session.scalar(select(JobRow).where(JobRow.id == job))
            if row is None or row.state != RUNNING or row.attempts != attempt:
                return
            if row.cancel_requested:
                history.enter(row, CANCELLED, "cancelled: its worker was stopped while it ran")
            else:
                row.attempts -= 1  # handed back in order: such a start is no failed attempt
                history.enter(row, QUEUED, "its worker was stopped while it ran: queued again")
        leftovers.remove(self.database, self.files, job)

    def _settle(self, ended: Ended) -> None:
        self._patiently(lambda: self.settler.settle(ended))

    def _patiently(self, ask: Callable[[], T]) -> T | None:
        """Ask the database until it answers, or the worker is to stop: then once more only."""
        while True:
            try:
                return ask()
            except Exception:
                logger.warning("the database could not be used: tried again", exc_info=True)
                if _stopping.wait(AGAIN_S):
                    return None
