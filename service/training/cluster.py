"""The queue of training jobs where a Dask cluster runs them.

The rows of the jobs say all that counts. For each job of this service that waits the scheduler has a ticket: a call of
`hosting.host`, which some worker makes once it is free. Tickets may be lost or come twice; a job is done by whoever
changes its row first. The service watches the row, and sees to it that a waiting job has a ticket.
"""

from __future__ import annotations

import logging
import time
from secrets import token_hex

from service import __version__
from service.contract.states import QUEUED
from service.runtime import remote
from service.runtime.cluster import Cluster, needs_gpu
from service.runtime.executors import ClusterUnavailableError, lost
from service.runtime.process import Slot
from service.storage.database import JobRow
from service.training import lifecycle
from service.training.lifecycle import Ended, Hand
from service.training.queue import JobQueue

logger = logging.getLogger(__name__)

AGAIN_S = 1.0
"""Seconds after which a job whose ticket was lost gets another one."""

HOST = "service.training.hosting:host"
"""What a worker does with a job; by name, since its module would be imported here and by the scheduler."""


class ClusterQueue(JobQueue):
    """Has workers of a cluster run jobs, and goes on with jobs of services that are gone; a job outlives its service.
    Which service owns a job says who watches it; the one that dies is followed by another."""

    def _places(self) -> list[Slot]:
        assert self.settings.cluster is not None
        self._away = self.cluster = Cluster(self.settings.cluster)  # here: the threads of the queue need it
        return []

    def recover(self) -> list[str]:
        """Go on with the jobs of an earlier run of this service; none has to be queued again."""
        self._inbox.put(self._look_around)
        return []

    def close(self) -> None:
        """Leave the jobs to other services, or to the next start: workers go on with those that run."""
        super().close()
        self._away.close()

    def _hand_back(self) -> None:
        self.replicas.leave()

    def _look_around(self) -> None:
        self._reconciled = -float("inf")

    def _see_to(self, row: JobRow, ours: bool) -> None:
        """Watch a job that runs on some worker."""
        self._hands.append(Hand(row.id, None, None, time.monotonic(), away=True))

    def _hand_out(self) -> None:
        clock = time.monotonic()
        known = {hand.job for hand in self._hands} | self._settling
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
                self._hands.append(Hand(job, None, future, clock, away=True))
            del self._waiting[job]

    def _announce(self, job: str) -> bool | None:
        """Make a waiting job this service's and say what it waits for: with a GPU? None where it does not."""
        with self.database.transaction() as session:
            row = lifecycle.row_of(session, job)
            if row is None or row.state != QUEUED or row.owner not in (None, self.replicas.id):
                return None
            gpu = needs_gpu(row.request)
            message = f"waits for a worker of the cluster{' with a GPU' if gpu else ''}"
            if not row.history or row.history[-1]["message"] != message:
                lifecycle.enter(row, QUEUED, message)
            row.owner = self.replicas.id
        return gpu

    def _look(self) -> None:
        super()._look()
        for hand in list(self._hands):
            if hand.future is None or self._away.knows(hand.future):
                continue
            future, hand.future = hand.future, None
            if hand.ran is not None:  # its row says how it is
                continue
            self._hands.remove(hand)
            error = future.exception(timeout=AGAIN_S) if future.status == "error" else None
            if error is None or lost(error):
                self._wait(hand.job, time.monotonic() + AGAIN_S)
            else:
                self._pass_on(Ended(hand.job, "refused", f"a worker could not begin with it: {error}"))

    def _end(self, hand: Hand) -> None:
        if hand.future is not None and hand.ran is None:  # a worker that has begun sees it in the row
            self._away.drop(hand.future)
