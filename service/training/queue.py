"""The queue of training jobs: rows in the database, worked off by a pool of other processes."""

from __future__ import annotations

import logging
import multiprocessing
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from sqlalchemy import select

from service.database import Database, JobRow, now
from service.settings import Settings
from service.training import worker
from service.training.process import start_process, training_place
from service.training.states import ACTIVE, CANCELLED, FAILED, QUEUED, RUNNING, SUCCEEDED

logger = logging.getLogger(__name__)


class JobQueue:
    """Hands queued jobs to training processes and takes back what an interruption left.

    trained: called with the model and the version that a job has made, in a thread of its own.
    """

    def __init__(self, settings: Settings, database: Database, trained: Callable[[str, int], None]) -> None:
        self.settings, self.database, self.trained = settings, database, trained
        self._lock = threading.Lock()
        self._closing = False
        self._pool = self._new_pool()

    def submit(self, job: str) -> None:
        """Hand a queued job to the next free training process."""
        with self._lock:
            if self._closing:
                return  # the row stays queued and is taken up at the next start
            try:
                future = self._pool.submit(worker.run, self.settings, job)
            except BrokenProcessPool:
                self._pool = self._new_pool()
                future = self._pool.submit(worker.run, self.settings, job)
        future.add_done_callback(lambda done: self._ended(job, done))

    def recover(self) -> list[str]:
        """Queue again every job that an earlier run of the service left unfinished; return their ids."""
        with self.database.transaction() as session:
            rows = list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)))
            ready = [row.id for row in rows if self._requeue(row)]
        for job in ready:
            self.submit(job)
        return ready

    def close(self) -> None:
        """Stop the training processes at once; their jobs stay in the database and go on at the next start."""
        with self._lock:
            self._closing = True
            pool = self._pool
        pool.kill_workers() if hasattr(pool, "kill_workers") else self._kill(pool)
        pool.shutdown(wait=True, cancel_futures=True)
        with self.database.transaction() as session:
            for row in session.scalars(select(JobRow).where(JobRow.state == RUNNING)):
                # handed back in order: such a start is no failed attempt
                row.state, row.attempts, row.progress = QUEUED, row.attempts - 1, {"stage": "waiting"}

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self.settings.training_workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=start_process,
            initargs=(training_place(self.settings),),
        )

    @staticmethod
    def _kill(pool: ProcessPoolExecutor) -> None:
        # Python < 3.14 has no public way to end a pool's processes
        for process in list((pool._processes or {}).values()):
            process.kill()

    def _requeue(self, row: JobRow) -> bool:
        """Make an interrupted job wait again, or end it where it was cancelled or tried too often."""
        if row.cancel_requested:
            row.state, row.finished_at = CANCELLED, now()
        elif row.attempts >= self.settings.max_job_attempts:
            row.state, row.finished_at = FAILED, now()
            message = f"the training process ended before its job, {row.attempts} times"
            row.error = {"code": "interrupted", "message": message}
        else:
            row.state, row.progress = QUEUED, {"stage": "waiting"}
            return True
        return False

    def _ended(self, job: str, future: Future[None]) -> None:
        if self._closing or future.cancelled():
            return
        error = future.exception()
        if error is None:
            threading.Thread(target=self._succeeded, args=(job,), daemon=True).start()
            return
        # the process died or could not reach the database: the job's row still says queued or running
        logger.error("the training process of job %s ended early: %r", job, error)
        # a broken pool calls back while it holds a lock that submitting needs: from another thread then
        threading.Thread(target=self._retry, args=(job,)).start()

    def _succeeded(self, job: str) -> None:
        with self.database.session() as session:
            row = session.scalar(select(JobRow).where(JobRow.id == job, JobRow.state == SUCCEEDED))
        if row is not None and row.version is not None:
            self.trained(row.model, row.version)

    def _retry(self, job: str) -> None:
        with self.database.transaction() as session:
            row = session.scalar(select(JobRow).where(JobRow.id == job, JobRow.state.in_(ACTIVE)))
            again = row is not None and self._requeue(row)
        if again:
            self.submit(job)
