"""What a running service needs to learn while it serves: ingest threads, monitors of models, the learner process."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import copy_context
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, TypeVar

from sqlalchemy import select

from service.contract.observations import ObservationRequest, ObservationResponse
from service.contract.states import PartState
from service.foundation.errors import BusyError
from service.journal import log
from service.learning.ingest.append import ObservationLog
from service.learning.ingest.frames import Frames, FramesResult, observe_frames
from service.learning.ingest.monitor import Monitor
from service.learning.ingest.observations import observe_batch
from service.learning.learner import publication
from service.learning.learner.process import LearnerProcess
from service.learning.learner.publication import Failed, Message, Published
from service.learning.live.feed import Feed
from service.models.loaded import LoadedModels, Served
from service.storage.database import StreamRow
from service.telemetry.readiness import Lasting

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
MOST_THREADS = 2
"""Batches taken at the same time; those of one model take turns."""
MOST_WAITING = 100
"""Batches that wait for their turn; more are refused, as their rows fill the memory."""
RESTART_S = 10.0
"""Time in s within which a learner process that died should have been started again, or one that stands still go on."""
MAX_LAG_S = 30.0
"""Time in s for which observations may wait to be learnt before readiness warns of it."""


class IngestThreads:
    """Few threads that take observations. Batches of one model come one after the other and keep no thread from others.

    They have the priority of the thread that answers. With a lower one they were stopped on a busy machine while they
    held what others wait for, the interpreter's and the database's lock: answers' p99 was 46 ms instead of 8 ms.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(MOST_THREADS, "ingest")
        self._turns: dict[str, asyncio.Lock] = {}
        self._arrived: dict[str, list[float]] = {}  # of batches that are not logged, by model

    def wait_s(self, model: str) -> float:
        """How long the batch of a model has waited that came first of those that are not logged, s. For any thread."""
        return max((perf_counter() - each for each in self._arrived.get(model, ())), default=0.0)

    async def run(self, model: str, work: Callable[..., Result], *args: Any, arrived: float | None = None) -> Result:
        """Do work on a model's log in the next free thread, in order of arrival; raise BusyError where too much waits
        already. arrived: of its first row, time of `perf_counter`, now where None. For the event loop."""
        waiting = sum(map(len, self._arrived.values())) - MOST_THREADS
        if waiting >= MOST_WAITING:
            raise BusyError(f"{waiting} batches are waiting to be logged, the most that may: try again later")
        arrived = perf_counter() if arrived is None else arrived
        self._arrived[model] = [*self._arrived.get(model, ()), arrived]
        try:
            async with self._turns.setdefault(model, asyncio.Lock()):
                # what has begun is done to its end, whether anyone still waits for it or not
                run = copy_context().run  # what is logged names the request
                done = asyncio.get_running_loop().run_in_executor(self._threads, run, work, *args)
                return await asyncio.shield(done)
        finally:
            left = list(self._arrived[model])
            left.remove(arrived)
            if left:
                self._arrived[model] = left
            else:
                del self._arrived[model], self._turns[model]

    def close(self) -> None:
        """Finish what has begun, and take no more."""
        self._threads.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class Status:
    """The learner process's latest messages about a version since the service started; None before the first one."""

    published: Published | None = None
    failed: Failed | None = None

    @property
    def novel_share(self) -> float | None:
        """Share of the latest samples beyond the basis; None before something is learnt."""
        return None if self.published is None else self.published.novel_share

    @property
    def failure(self) -> str | None:
        """Why the version does not learn, None while it does."""
        return None if self.failed is None else self.failed.error


@dataclass(frozen=True)
class Lag:
    """How far answers lag behind what has arrived. rows: that are logged, to be learnt, and not in answers; seconds:
    since the first of these arrived, or of those that wait to be logged."""

    rows: int
    seconds: float


class Learners:
    """Learning of all models; safe from several threads. Close it before the database.

    process: the learner process; weighing: what streams carry. threads: those that take observations. live: the feed of
    those who follow models.
    when_published: called with each such message of the learner process, in its reader's thread, after a revision
    answers; to be filled before the first batch.
    """

    def __init__(self, loaded: LoadedModels) -> None:
        storage = loaded.storage
        settings, database = storage.settings, storage.database
        self.settings, self.database, self.loaded = settings, database, loaded
        self.when_published: list[Callable[[Published], None]] = []
        self.threads = IngestThreads()
        self._lock = threading.Lock()
        self._monitors: dict[str, Monitor] = {}
        self._status: dict[tuple[str, int], Status] = {}
        self._revisions: dict[tuple[str, int], int] = {}  # of versions that were behind, at the last look
        self.process = LearnerProcess(settings, self._receive)
        loaded.learn_from(self.process.wake)
        loaded.when_deleted.append(self.forget)
        self.live = Feed()
        self._log = ObservationLog(loaded, self._monitor, self.monitors, self.process.wake, self.live.note)
        self.weighing = self._log.weighing

    def close(self) -> None:
        """Finish the batches that have begun, and end the processes; the learner stores its state."""
        self.threads.close()
        self.weighing.close()
        self.process.close()

    def observe(self, model: str, request: ObservationRequest) -> ObservationResponse:
        """Take a batch of observations; see `observations.observe_batch`. Not for the event loop."""
        return observe_batch(self._log, model, request)

    def observe_frames(self, frames: Frames) -> FramesResult:
        """Take frames of a stream; see `frames.observe_frames`. Not for the event loop."""
        return observe_frames(self._log, frames)

    def monitor(self, model: str) -> Monitor:
        """The monitor of a model, up to the batches that other services have logged by now. Not for the event loop.
        Raise NotFoundError or UnreadableVersionError."""
        monitor = self._monitor(self.loaded.get(model, None))
        self._log.follow(monitor, model)
        return monitor

    def turn(self, model: str) -> AbstractContextManager[None]:
        """See `ObservationLog.turn`; raise as `monitor` does. Not for the event loop."""
        return self._log.turn(self._monitor(self.loaded.get(model, None)), model)

    def follow(self, models: Collection[str] | None = None) -> None:
        """Bring the monitors of these models up to the batches that other services have logged, of all models in memory
        where None. Not for the event loop."""
        if models is None:
            self.watched()
        else:
            for model in models:
                self.monitor(model)

    def monitors(self) -> dict[str, Monitor]:
        """Those of the models that have learnt or have been looked at since the service started."""
        with self._lock:
            return dict(self._monitors)

    def watched(self) -> dict[str, Monitor]:
        """Monitors by model: those there are, and of models in memory that have got observations before the start. No
        model is loaded for it, which would drop another one. Not for the event loop."""
        with self.database.session() as session:
            learning = list(session.scalars(select(StreamRow.model).distinct()))
        fresh = {}
        for model in learning:
            if (served := self.loaded.peek(model)) is not None:
                fresh[model] = self._monitor(served)
                self._log.follow(fresh[model], model)
        return dict(sorted((self.monitors() | fresh).items()))

    def forget(self, model: str) -> None:
        """Keep nothing of a model that has been deleted."""
        self.live.forget(model)
        self.weighing.forget(model)
        with self._lock:
            self._monitors.pop(model, None)
            self._status = {key: status for key, status in self._status.items() if key[0] != model}

    def look(self, lasting: Lasting) -> tuple[PartState, str]:
        """Whether the learner process runs and gets on where something learns, for readiness; not for the event loop.
        What waits is a warning: of one version that cannot learn, others and all answers know nothing."""
        if not self.process.needed:
            return "ok", "not needed yet"
        gone = lasting(self.process.pid is None)
        if gone is not None and gone <= RESTART_S:
            return "warning", "is being started"
        if gone is not None:
            return "failed", f"has not run for {gone:.0f} s: observations are stored, but not learnt"
        if (silent_s := self.process.silent_s) > RESTART_S:
            return "failed", f"has not got on for {silent_s:.0f} s: observations are stored, but not learnt"
        behind, stands = self._behind()
        waited = lasting(stands, "lag")
        if waited is not None and waited > MAX_LAG_S:
            return "warning", f"runs, but {behind} events wait, of which it has learnt none for {waited:.0f} s"
        return "ok", "runs"

    def _behind(self) -> tuple[int, bool]:
        """Events that wait to be learnt by versions that answer, and whether one of these has not learnt since this was
        asked last."""
        behind, before = 0, self._revisions
        self._revisions = {}
        with self.database.session() as session:
            for model in self.monitors():
                served = self.loaded.peek(model)
                if served is None:
                    continue
                key = model, served.version
                wait = log.newest(session, model) - log.start_of(session, *key) - served.revision
                if wait > 0:
                    behind += wait
                    self._revisions[key] = served.revision
        return behind, any(before.get(key) == revision for key, revision in self._revisions.items())

    def lag(self, served: Served) -> Lag:
        """How far the answers of a version lag behind. Not for the event loop."""
        model = served.name
        with self.database.session() as session:
            contained = log.start_of(session, model, served.version) + served.revision
            rows, arrived = log.pending(session, model, contained)
        waited = 0.0 if arrived is None else max(time.time() - arrived, 0.0)
        return Lag(rows, max(waited, self.threads.wait_s(model)))

    def status(self, model: str, version: int) -> Status:
        """The learner process's latest messages about a version."""
        with self._lock:
            return self._status.get((model, version), Status())

    def _monitor(self, served: Served) -> Monitor:
        """The monitor of a model, made when it is first needed, or when another version has other joints."""
        with self._lock:
            known = self._monitors.get(served.name)
            if known is not None and known.joint_names == served.model.joint_names:
                return known
            with self.database.session() as session:
                monitor = Monitor.rebuilt(session, served.name, served.model.joint_names, time.time())
            if known is not None:
                monitor.lock = known.lock  # batches of a model are logged one at a time, whatever its joints
            self._monitors[served.name] = monitor
            return monitor

    def _note(self, message: Published | Failed, **latest: Any) -> None:
        key = message.model, message.version
        with self._lock:
            self._status[key] = replace(self._status.get(key, Status()), **latest)

    def _receive(self, message: Message) -> None:
        """Act on a message of the learner process; called in its reader's thread."""
        if isinstance(message, Published):
            # an immutable revision takes the place of the one before
            self.loaded.revise(message.model, message.version, message.revision, publication.read(message.path))
            self._note(message, published=message, failed=None)
            for call in self.when_published:
                call(message)
        elif isinstance(message, Failed):
            logger.error("version %s of model %s does not learn: %s", message.version, message.model, message.error)
            self._note(message, failed=message)
