"""Job queue for a Dask cluster that runs the training.

The rows of the jobs are the only source of truth. For each waiting job of this service the scheduler has a ticket: a
call of `hosting.host`, which a free worker makes. Tickets may be lost or arrive twice; the worker that changes the row
first runs the job. The service watches the row and submits another ticket if one is lost.
"""

from __future__ import annotations

import logging
import time
from secrets import token_hex

from service import __version__
from service.contract.states import QUEUED
from service.runtime import remote
from service.runtime.cluster import Cluster, needs_gpu
from service.runtime.executors import ClusterUnavailableError, is_worker_lost
from service.runtime.process import Slot
from service.storage.database import JobRow
from service.training import lifecycle, texts
from service.training.lifecycle import JobEnd, WatchedJob
from service.training.queue import JobQueue

logger = logging.getLogger(__name__)

RETRY_S = 1.0
"""Delay before a job with a lost ticket gets another one, s."""

HOST = "service.training.hosting:host"
"""Function that a worker calls for a job, as a name: the service and the scheduler must not import its module."""


class ClusterQueue(JobQueue):
    """Queue of jobs that run on workers of a cluster and outlive their service.

    The owner of a job is the service that watches it. If that service stops, another one takes its jobs over.
    """

    def _places(self) -> list[Slot]:
        assert self.settings.cluster is not None
        self._away = self.cluster = Cluster(self.settings.cluster)  # here: the threads of the queue need it
        return []

    def recover(self) -> list[str]:
        """Resume watching the jobs of an earlier run; none has to be queued again."""
        self._inbox.put(self._reconcile_soon)
        return []

    def close(self) -> None:
        """Leave the jobs to other services or to the next start; workers continue those that run."""
        super().close()
        self._away.close()

    def _release_jobs(self) -> None:
        self.replicas.release_jobs()

    def _reconcile_soon(self) -> None:
        self._reconciled = -float("inf")

    def _recover_job(self, row: JobRow, ours: bool) -> None:
        """Watch a job that runs on a worker."""
        self._watched_jobs.append(WatchedJob(row.id, None, None, time.monotonic(), away=True))

    def _start_waiting(self) -> None:
        clock = time.monotonic()
        known = {watched.job for watched in self._watched_jobs} | self._settling
        for job in [job for job, at in self._waiting.items() if at <= clock and job not in known]:
            if self._closing.is_set() or self._away.problem is not None:
                return
            gpu = self._announce(job)
            if gpu is not None:
                key = f"lipserve-job-{job}-{token_hex(4)}"
                try:
                    future = self._away.submit(key, gpu, remote.call_named, HOST, __version__, job)
                except ClusterUnavailableError as error:
                    logger.warning("%s waits: %s", job, error)
                    return
                self._watched_jobs.append(WatchedJob(job, None, future, clock, away=True))
            del self._waiting[job]

    def _announce(self, job: str) -> bool | None:
        """Take ownership of a waiting job; return whether it needs a GPU.

        Return None if it no longer waits for this service.
        """
        with self.database.transaction() as session:
            row = lifecycle.row_of(session, job)
            if row is None or row.state != QUEUED or row.owner not in (None, self.replicas.id):
                return None
            gpu = needs_gpu(row.request)
            message = texts.describe_cluster_wait(gpu)
            if not row.history or row.history[-1]["message"] != message:
                lifecycle.enter(row, QUEUED, message)
            row.owner = self.replicas.id
        return gpu

    def _check_jobs(self) -> None:
        super()._check_jobs()
        for watched in list(self._watched_jobs):
            if watched.future is None or self._away.knows(watched.future):
                continue
            future, watched.future = watched.future, None
            if watched.ran is not None:  # its row has the state
                continue
            self._watched_jobs.remove(watched)
            error = future.exception(timeout=RETRY_S) if future.status == "error" else None
            if error is None or is_worker_lost(error):
                self._wait(watched.job, time.monotonic() + RETRY_S)
            else:
                self._settle_later(JobEnd(watched.job, "refused", f"a worker could not start the job: {error}"))

    def _end(self, watched: WatchedJob) -> None:
        if watched.future is not None and watched.ran is None:  # a worker that has begun reads its row
            self._away.drop(watched.future)
