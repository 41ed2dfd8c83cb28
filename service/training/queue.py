"""The queue of training jobs: rows in the database, worked off by other processes, each watched by one thread here.

Three threads share the work. The watcher alone knows which process has which job; it only reads the database, so that
no lock there keeps it from ending a process. The clerk writes what becomes of jobs whose process ended, again and again
until it is written. A version that was made is loaded in a thread of its own.
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
from service.runtime.process import Slot, training_place
from service.storage.database import JobRow
from service.storage.replicas import Replicas
from service.storage.storage import Storage
from service.training import lifecycle, worker
from service.training.feed import Feed
from service.training.lifecycle import Ended, Facts, Hand, Settled, Settler, queue_again

logger = logging.getLogger(__name__)

WATCH_S = 0.2
"""Seconds between two looks at the jobs that run."""
AGAIN_S = 1.0
"""Seconds after which the clerk tries again to write what the database did not take."""


class JobQueue:
    """Hands queued jobs to training processes, watches these, and takes back what an interruption left.

    Where several services share the database, a job that waits is anybody's: who hands it out first owns it.

    trained: called with the model and the version that a job has made, in a thread of its own.
    """

    def __init__(self, storage: Storage, trained: Callable[[str, int], None]) -> None:
        settings, database = storage.settings, storage.database
        self.storage, self.settings, self.database, self.trained = storage, settings, database, trained
        self.feed = Feed(database)
        self.problem: str | None = None
        """Why training processes cannot be started, None while they can as far as is known."""
        self.replicas = Replicas(settings, database)
        self._settler = Settler(database, storage.files, self.replicas.mine)
        self.cluster: Cluster | None = None
        self._slots = self._places()
        self._hands: list[Hand] = []
        self._waiting: dict[str, float] = {}  # when each may be handed out, monotonic, in the order of coming
        self._settling: set[str] = set()
        self._watched = self._reconciled = time.monotonic()
        self._closing = threading.Event()
        self._inbox: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._desk: queue.SimpleQueue[Ended | None] = queue.SimpleQueue()
        self._watcher = threading.Thread(target=self._watch, daemon=True, name="job-watcher")
        self._clerk = threading.Thread(target=self._settle, daemon=True, name="job-clerk")
        self._watcher.start()
        self._clerk.start()

    def _places(self) -> list[Slot]:
        return [Slot(training_place(self.settings)) for _ in range(self.settings.training_workers)]

    def submit(self, job: str) -> None:
        """Hand a queued job to the next free training process."""
        self._inbox.put(partial(self._wait, job))

    def stop(self, job: str) -> None:
        """End the process that runs a job, if one does, unless it ends within `JobLimits.cancel_s`: it is cancelled."""
        self._inbox.put(partial(self._stop, job))

    @property
    def silent_s(self) -> float:
        """Longest time in s for which a process that runs a job has given no sign of life."""
        clock = time.monotonic()
        return max((clock - each.beat_at for each in list(self._hands) if each.ran is not None), default=0.0)

    def recover(self) -> list[str]:
        """Queue again every job that an earlier run of the service left unfinished; return their ids."""
        with self.database.transaction() as session:
            rows = list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)))
            ours = (None, self.replicas.id)
            ready = [row.id for row in rows if row.owner in ours and self._is_ready(row)]
        for job in ready:
            self.submit(job)
        return ready

    def close(self) -> None:
        """Stop the training processes at once; their jobs stay in the database and go on at the next start."""
        self._closing.set()
        self._inbox.put(lambda: None)
        self._desk.put(None)
        self._watcher.join()
        for slot in self._slots:
            slot.close()
        self._clerk.join()
        try:
            self._hand_back()
        except Exception:  # as after a kill: the next start finds them
            logger.exception("running jobs could not be handed back")
        self.replicas.close()

    def _hand_back(self) -> None:
        with self.database.transaction() as session:
            for row in session.scalars(select(JobRow).where(JobRow.state == RUNNING)):
                if self.replicas.mine(row.owner):
                    lifecycle.hand_back(row, "the service was stopped while it ran")

    def _is_ready(self, row: JobRow) -> bool:
        if row.state == QUEUED and not row.cancel_requested:
            return True
        return queue_again(row, "the service was killed while it ran", lifecycle.LIMITS.attempts)

    # the watcher: all below until the clerk runs in its thread alone

    def _watch(self) -> None:
        while not self._closing.is_set():
            try:
                self._inbox.get(timeout=WATCH_S if self._hands or self._waiting else self.replicas.reconcile_s)()
            except queue.Empty:
                pass
            except Exception:
                logger.exception("the queue of jobs goes on after an error")
            for step in (self._look, self._reconcile, self._hand_out):
                try:
                    step()
                except Exception:  # of the database: the next look may find it well again
                    logger.exception("the queue of jobs goes on after an error")

    def _wait(self, job: str, ready: float = 0.0) -> None:
        self._waiting.setdefault(job, ready)

    def _stop(self, job: str) -> None:
        for hand in self._hands:
            if hand.job == job:
                hand.stop(time.monotonic())

    def _hand_out(self) -> None:
        busy = {hand.slot for hand in self._hands}
        running = {hand.job for hand in self._hands} | self._settling
        clock = time.monotonic()
        free = [slot for slot in self._slots if slot not in busy]
        ready = [job for job, at in self._waiting.items() if at <= clock and job not in running]
        for slot, job in zip(free, ready, strict=False):
            if self._closing.is_set():
                return
            owned = self.replicas.take(job, None)
            del self._waiting[job]
            if not owned:  # another service was faster
                continue
            try:
                future = slot.start(worker.run, self.settings, job)
            except Exception as error:  # no memory, too many processes
                self._pass_on(Ended(job, "ended", f"a training process could not be started: {error}"))
                continue
            hand = Hand(job, slot, future, clock)
            self._hands.append(hand)
            # called by a thread of the pool, which may hold its lock
            future.add_done_callback(lambda _, hand=hand: self._inbox.put(partial(self._ended, hand)))  # type: ignore[misc]

    def _look(self) -> None:
        """See how the jobs that run are doing, and end the processes that have to be."""
        clock = time.monotonic()
        if not self._hands or clock - self._watched < WATCH_S:
            return
        self._watched = clock
        try:
            self._read(clock)
        finally:
            for hand in list(self._hands):
                if ended := hand.judge(self.settings, clock):
                    self._hands.remove(hand)
                    self._end(hand)
                    self._pass_on(ended)

    def _end(self, hand: Hand) -> None:
        hand.slot.kill()

    def _read(self, clock: float) -> None:
        columns = JobRow.state, JobRow.heartbeat_at, JobRow.cancel_requested, JobRow.attempts
        jobs = [hand.job for hand in self._hands]
        with self.database.session() as session:
            rows = session.execute(select(JobRow.id, JobRow.owner, *columns).where(JobRow.id.in_(jobs)))
            facts = {
                job: Facts(state, beat, cancel, attempts, self.replicas.mine(owner))
                for job, owner, state, beat, cancel, attempts in rows
            }
        for hand in self._hands:
            if hand.job in facts:
                hand.see(facts[hand.job], clock)
            if hand.ran is not None:
                self.problem = None

    def _ended(self, hand: Hand) -> None:
        if hand not in self._hands:
            return  # it was ended, and its job passed on
        self._hands.remove(hand)
        error = hand.future.exception()
        if error is None:
            self._pass_on(Ended(hand.job, "returned", "the training process gave it back"))
        elif isinstance(error, BrokenProcessPool):
            self._pass_on(Ended(hand.job, "ended", f"the training process {hand.slot.ending()}"))
        else:
            self._pass_on(Ended(hand.job, "ended", f"the training process could not go on: {error}"))

    def _pass_on(self, ended: Ended) -> None:
        self._settling.add(ended.job)
        self._desk.put(ended)

    def _reconcile(self) -> None:
        clock = time.monotonic()
        if clock - self._reconciled < self.replicas.reconcile_s:
            return
        self._reconciled = clock
        known = {hand.job for hand in self._hands} | self._settling | self._waiting.keys()
        with self.database.session() as session:
            rows = list(session.scalars(select(JobRow).where(JobRow.state.in_(ACTIVE)).order_by(JobRow.seq)))
            free = self.replicas.free(session)
        for row in rows:
            if row.id in known:
                continue
            ours = self.replicas.mine(row.owner)
            # a job that waits and is nobody's is taken when it is handed out
            anybodys = row.state == QUEUED and row.owner is None
            if not ours and not (row.owner in free and (anybodys or self.replicas.take(row.id, row.owner))):
                continue
            if row.state == QUEUED:
                self.submit(row.id)
            else:
                self._see_to(row, ours)

    def _see_to(self, row: JobRow, ours: bool) -> None:
        """See to a job that runs, but not in a process of this service. ours: not taken over just now."""
        if not ours:
            self._pass_on(Ended(row.id, "ended", "the service that had it run is gone"))
        elif _age(row.heartbeat_at) > lifecycle.LIMITS.heartbeat_s:
            self._pass_on(Ended(row.id, "ended", "no process runs it"))

    def _settled(self, job: str, settled: Settled) -> None:
        self._settling.discard(job)
        if settled.problem is not None:
            self.problem = settled.problem
        if settled.again and settled.pause_s:
            self._wait(job, time.monotonic() + settled.pause_s)
        elif settled.again:
            self.submit(job)
        else:
            self._waiting.pop(job, None)  # where it was handed in twice

    # the clerk

    def _settle(self) -> None:
        while (ended := self._desk.get()) is not None:
            settled = None
            while settled is None and not self._closing.is_set():
                try:
                    settled = self._settler.settle(ended)
                except Exception:
                    logger.exception("what becomes of %s could not be written: tried again", ended.job)
                    self._closing.wait(AGAIN_S)
            if settled is None:
                return
            if settled.made is not None:
                threading.Thread(target=self.trained, args=settled.made, daemon=True).start()
            self._inbox.put(partial(self._settled, ended.job, settled))


def _age(moment: str | None) -> float:
    """Seconds since a moment of the wall clock, infinite where there was none."""
    if moment is None:
        return float("inf")
    return (datetime.now(UTC) - datetime.fromisoformat(moment)).total_seconds()


def queue_of(settings: Settings) -> type[JobQueue]:
    """The kind of queue that the settings ask for."""
    if settings.cluster is None:
        return JobQueue
    from service.training.cluster import ClusterQueue  # noqa: PLC0415 - it is one of these

    return ClusterQueue
