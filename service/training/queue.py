"""Job queue: rows in the database, run by training processes, each watched by one thread here.

Three threads share the work. The watcher alone tracks which process has which job; it only reads the database, so that
no lock there keeps it from killing a process. When the process of a job has ended, the clerk writes
the outcome, and retries until it is written. A new version is loaded in its own thread.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from datetime import UTC, datetime
from functools import partial

from sqlalchemy import select

from service.contract.states import ACTIVE, QUEUED, RUNNING
from service.foundation.settings import Settings
from service.runtime.cluster import Cluster
from service.runtime.process import Slot, training_process_options
from service.storage.database import JobRow
from service.storage.replicas import Replicas
from service.storage.storage import Storage
from service.training import lifecycle, texts, worker
from service.training.feed import JobEventStream
from service.training.lifecycle import JobEnd, JobOutcome, JobStatus, Settler, WatchedJob, queue_again

logger = logging.getLogger(__name__)

WATCH_S = 0.2
"""Interval between two checks of the running jobs, s."""
RETRY_S = 1.0
"""Delay before the clerk repeats a failed write to the database, s."""


class JobQueue:
    """Gives queued jobs to training processes, watches these, and queues interrupted jobs again.

    If several services share the database, a waiting job belongs to the first that starts it. `trained` is called with
    the model and version that a job has made, in its own thread.
    """

    def __init__(self, storage: Storage, trained: Callable[[str, int], None]) -> None:
        settings, database = storage.settings, storage.database
        self.storage, self.settings, self.database, self.trained = storage, settings, database, trained
        self.feed = JobEventStream(database)
        self.problem: str | None = None
        """Why training processes cannot be started, None if there is no known problem."""
        self.replicas = Replicas(settings, database)
        self._settler = Settler(database, storage.files, self.replicas.is_mine)
        self.cluster: Cluster | None = None
        self._slots = self._places()
        self._watched_jobs: list[WatchedJob] = []
        self._waiting: dict[str, float] = {}  # earliest start of each job, monotonic, in order of arrival
        self._settling: set[str] = set()
        self._watched = self._reconciled = time.monotonic()
        self._closing = threading.Event()
        self._inbox: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._desk: queue.SimpleQueue[JobEnd | None] = queue.SimpleQueue()
        self._watcher = threading.Thread(target=self._watch, daemon=True, name="job-watcher")
        self._clerk = threading.Thread(target=self._settle, daemon=True, name="job-clerk")
        self._watcher.start()
        self._clerk.start()

    def _places(self) -> list[Slot]:
        return [Slot(training_process_options(self.settings)) for _ in range(self.settings.training_workers)]

    def submit(self, job: str) -> None:
        """Queue a job for the next free training process."""
        self._inbox.put(partial(self._wait, job))

    def stop(self, job: str) -> None:
        """Cancel a job: kill its process unless it ends within `JobLimits.cancel_s`."""
        self._inbox.put(partial(self._stop, job))

    @property
    def silent_s(self) -> float:
        """Longest time since the last heartbeat of a process that runs a job, s."""
        clock = time.monotonic()
        return max((clock - each.beat_at for each in list(self._watched_jobs) if each.ran is not None), default=0.0)

    def recover(self) -> list[str]:
        """Queue every job again that an earlier run of the service left unfinished; return their ids."""
        with self.database.transaction() as session:
            rows = list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)))
            ours = (None, self.replicas.id)
            ready = [row.id for row in rows if row.owner in ours and self._is_ready(row)]
        for job in ready:
            self.submit(job)
        return ready

    def close(self) -> None:
        """Stop the training processes at once; their jobs stay in the database and run again at the next start."""
        self._closing.set()
        self._inbox.put(lambda: None)
        self._desk.put(None)
        self._watcher.join()
        for slot in self._slots:
            slot.close()
        self._clerk.join()
        try:
            self._release_jobs()
        except Exception:  # the next start finds them, as after a kill
            logger.exception("could not queue the running jobs again")
        self.replicas.close()

    def _release_jobs(self) -> None:
        with self.database.transaction() as session:
            for row in session.scalars(select(JobRow).where(JobRow.state == RUNNING)):
                if self.replicas.is_mine(row.owner):
                    lifecycle.requeue(row, texts.SERVICE_STOPPED)

    def _is_ready(self, row: JobRow) -> bool:
        if row.state == QUEUED and not row.cancel_requested:
            return True
        return queue_again(row, texts.SERVICE_KILLED, lifecycle.LIMITS.attempts)

    # everything down to the clerk runs only in the watcher's thread

    def _watch(self) -> None:
        while not self._closing.is_set():
            try:
                self._inbox.get(timeout=WATCH_S if self._watched_jobs or self._waiting else self.replicas.reconcile_s)()
            except queue.Empty:
                pass
            except Exception:
                logger.exception("error in the job queue, which continues")
            for step in (self._check_jobs, self._reconcile, self._start_waiting):
                try:
                    step()
                except Exception:  # a database error: the next check may succeed
                    logger.exception("error in the job queue, which continues")

    def _wait(self, job: str, ready: float = 0.0) -> None:
        self._waiting.setdefault(job, ready)

    def _stop(self, job: str) -> None:
        for watched in self._watched_jobs:
            if watched.job == job:
                watched.stop(time.monotonic())

    def _start_waiting(self) -> None:
        busy = {watched.slot for watched in self._watched_jobs}
        running = {watched.job for watched in self._watched_jobs} | self._settling
        clock = time.monotonic()
        free = [slot for slot in self._slots if slot not in busy]
        ready = [job for job, at in self._waiting.items() if at <= clock and job not in running]
        for slot, job in zip(free, ready, strict=False):
            if self._closing.is_set():
                return
            owned = self.replicas.claim(job, None)
            del self._waiting[job]
            if not owned:  # another service was faster
                continue
            try:
                future = slot.start(worker.run, self.settings, job)
            except Exception as error:  # no memory, too many processes
                self._settle_later(JobEnd(job, "ended", texts.describe_start_failure(error)))
                continue
            watched = WatchedJob(job, slot, future, clock)
            self._watched_jobs.append(watched)
            # called by a thread of the pool that may hold its lock, so it only puts a message
            future.add_done_callback(lambda _, watched=watched: self._inbox.put(partial(self._ended, watched)))  # type: ignore[misc]

    def _check_jobs(self) -> None:
        """Check the running jobs, and kill processes that must end."""
        clock = time.monotonic()
        if not self._watched_jobs or clock - self._watched < WATCH_S:
            return
        self._watched = clock
        try:
            self._read(clock)
        finally:
            for watched in list(self._watched_jobs):
                if end := watched.judge(self.settings, clock):
                    self._watched_jobs.remove(watched)
                    self._end(watched)
                    self._settle_later(end)

    def _end(self, watched: WatchedJob) -> None:
        watched.slot.kill()

    def _read(self, clock: float) -> None:
        columns = JobRow.state, JobRow.heartbeat_at, JobRow.cancel_requested, JobRow.attempts
        jobs = [watched.job for watched in self._watched_jobs]
        with self.database.session() as session:
            rows = session.execute(select(JobRow.id, JobRow.owner, *columns).where(JobRow.id.in_(jobs)))
            status = {
                job: JobStatus(state, beat, cancel, attempts, self.replicas.is_mine(owner))
                for job, owner, state, beat, cancel, attempts in rows
            }
        for watched in self._watched_jobs:
            if watched.job in status:
                watched.update(status[watched.job], clock)
            if watched.ran is not None:
                self.problem = None

    def _ended(self, watched: WatchedJob) -> None:
        if watched not in self._watched_jobs:
            return  # it was killed, and the clerk has its job
        self._watched_jobs.remove(watched)
        error = watched.future.exception()
        if error is None:
            self._settle_later(JobEnd(watched.job, "returned", texts.RETURNED))
        elif isinstance(error, BrokenProcessPool):
            self._settle_later(JobEnd(watched.job, "ended", f"the training process {watched.slot.ending()}"))
        else:
            self._settle_later(JobEnd(watched.job, "ended", texts.describe_process_failure(error)))

    def _settle_later(self, end: JobEnd) -> None:
        self._settling.add(end.job)
        self._desk.put(end)

    def _reconcile(self) -> None:
        clock = time.monotonic()
        if clock - self._reconciled < self.replicas.reconcile_s:
            return
        self._reconciled = clock
        known = {watched.job for watched in self._watched_jobs} | self._settling | self._waiting.keys()
        with self.database.session() as session:
            rows = list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)))
            free = self.replicas.list_claimable_owners(session)
        for row in rows:
            if row.id in known:
                continue
            ours = self.replicas.is_mine(row.owner)
            # a waiting job without owner is claimed when it is started
            anybodys = row.state == QUEUED and row.owner is None
            if not ours and not (row.owner in free and (anybodys or self.replicas.claim(row.id, row.owner))):
                continue
            if row.state == QUEUED:
                self.submit(row.id)
            else:
                self._recover_job(row, ours)

    def _recover_job(self, row: JobRow, ours: bool) -> None:
        """Settle a job that runs by its row but not in a process here.

        `ours` is False if it was just taken over.
        """
        if not ours:
            self._settle_later(JobEnd(row.id, "ended", texts.SERVICE_GONE))
        elif _age(row.heartbeat_at) > lifecycle.LIMITS.heartbeat_s:
            self._settle_later(JobEnd(row.id, "ended", texts.NO_PROCESS))

    def _settled(self, job: str, outcome: JobOutcome) -> None:
        self._settling.discard(job)
        if outcome.problem is not None:
            self.problem = outcome.problem
        if outcome.again and outcome.pause_s:
            self._wait(job, time.monotonic() + outcome.pause_s)
        elif outcome.again:
            self.submit(job)
        else:
            self._waiting.pop(job, None)  # if it was submitted twice

    # the clerk

    def _settle(self) -> None:
        while (end := self._desk.get()) is not None:
            outcome = None
            while outcome is None and not self._closing.is_set():
                try:
                    outcome = self._settler.settle(end)
                except Exception:
                    logger.exception("the outcome of %s could not be stored; retrying", end.job)
                    self._closing.wait(RETRY_S)
            if outcome is None:
                return
            if outcome.made is not None:
                threading.Thread(target=self.trained, args=outcome.made, daemon=True).start()
            self._inbox.put(partial(self._settled, end.job, outcome))


def _age(moment: str | None) -> float:
    """Return the seconds since a wall clock time, infinite if None."""
    if moment is None:
        return float("inf")
    return (datetime.now(UTC) - datetime.fromisoformat(moment)).total_seconds()


def queue_of(settings: Settings) -> type[JobQueue]:
    """Return the queue class for the settings."""
    if settings.cluster is None:
        return JobQueue
    from service.training.cluster import ClusterQueue  # noqa: PLC0415 - it is a subclass of JobQueue

    return ClusterQueue
