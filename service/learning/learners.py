"""Learning in a running service: ingest threads, monitors of the models, the learner process."""

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
from service.learning import texts
from service.learning.ingest.append import ObservationLog
from service.learning.ingest.frames import Frames, FramesResult, observe_frames
from service.learning.ingest.monitor import Monitor
from service.learning.ingest.observations import observe_batch
from service.learning.learner import publication
from service.learning.learner.process import LearnerProcess
from service.learning.learner.publication import LearningFailure, Message, Publication
from service.learning.live.feed import Feed
from service.models.loaded import LoadedModels, ServedModel
from service.storage.database import ModelRow, StreamRow
from service.telemetry.readiness import FaultAge

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
MAX_THREADS = 2
"""Batches ingested at the same time. Batches of one model take turns."""
MAX_WAITING_BATCHES = 100
"""Batches that may wait for their turn. More are rejected, because their rows fill the memory."""
RESTART_S = 10.0
"""Seconds in which a dead learner process must be started again, or a silent one must make progress."""
MAX_LAG_S = 30.0
"""Seconds that observations may wait to be learnt before readiness warns."""


class IngestThreads:
    """A few threads that ingest batches: those of one model in order, without blocking other models.

    The threads have the priority of the thread that answers. At a lower priority, a busy machine suspends them while
    they hold locks of the interpreter and the database: the p99 of answers was 46 ms instead of 8 ms.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(MAX_THREADS, "ingest")
        self._turns: dict[str, asyncio.Lock] = {}
        self._arrived: dict[str, list[float]] = {}  # times of the batches that are not logged yet, by model

    def wait_s(self, model: str) -> float:
        """Return how long the oldest batch of a model has waited to be logged, s. For any thread."""
        return max((perf_counter() - each for each in self._arrived.get(model, ())), default=0.0)

    async def run(self, model: str, work: Callable[..., Result], *args: Any, arrived: float | None = None) -> Result:
        """Run work on a model's log in the next free thread, in order of arrival.

        arrived: time at which the first row arrived, by `perf_counter`; None: now. Raise BusyError if too many batches
        wait. Call it in the event loop.
        """
        waiting = sum(map(len, self._arrived.values())) - MAX_THREADS
        if waiting >= MAX_WAITING_BATCHES:
            raise BusyError(f"too many observation batches wait to be logged ({waiting}): retry later")
        arrived = perf_counter() if arrived is None else arrived
        self._arrived[model] = [*self._arrived.get(model, ()), arrived]
        try:
            async with self._turns.setdefault(model, asyncio.Lock()):
                # work that has started is finished, even if the request is cancelled
                run = copy_context().run  # log lines name the request
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
        """Finish the running batches and reject further ones."""
        self._threads.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class LearnerStatus:
    """The latest messages of the learner process about a version; None before the first one."""

    published: Publication | None = None
    failed: LearningFailure | None = None

    @property
    def novel_share(self) -> float | None:
        """Share of the latest samples beyond the basis; None before anything is learnt."""
        return None if self.published is None else self.published.novel_share

    @property
    def failure(self) -> str | None:
        """Why the version does not learn; None if it does."""
        return None if self.failed is None else self.failed.error


@dataclass(frozen=True)
class Lag:
    """How far answers lag behind arrivals."""

    rows: int
    """Rows that are logged and to be learnt, but not contained in answers yet."""
    seconds: float
    """Seconds since the first of these rows arrived, or the first batch that waits to be logged."""


class Learners:
    """Learning of all models, safe from several threads. Close it before the database.

    - process: the learner process.
    - weighing: follows the payloads of streams.
    - threads: ingest batches.
    - live: feed for clients that follow models.
    - on_published: functions called with each publication once its revision serves, in the thread that reads from the
      learner process. Add them before the first batch.
    """

    def __init__(self, loaded: LoadedModels) -> None:
        storage = loaded.storage
        settings, database = storage.settings, storage.database
        self.settings, self.database, self.loaded = settings, database, loaded
        self.on_published: list[Callable[[Publication], None]] = []
        self.threads = IngestThreads()
        self._lock = threading.Lock()
        self._monitors: dict[str, Monitor] = {}
        self._status: dict[tuple[str, int], LearnerStatus] = {}
        self._revisions: dict[tuple[str, int], int] = {}  # of versions that were behind at the last check
        self.process = LearnerProcess(settings, self._receive)
        loaded.learn_from(self.process.wake)
        loaded.when_deleted.append(self.forget)
        self.live = Feed()
        self._log = ObservationLog(loaded, self._monitor, self.monitors, self.process.wake, self.live.add_batch)
        self.weighing = self._log.weighing

    def close(self) -> None:
        """Finish the running batches and end the processes. The learner stores its state."""
        self.threads.close()
        self.weighing.close()
        self.process.close()

    def observe(self, model: str, request: ObservationRequest) -> ObservationResponse:
        """Log an observation batch, see `observations.observe_batch`. Blocking: use it in a thread."""
        return observe_batch(self._log, model, request)

    def observe_frames(self, frames: Frames) -> FramesResult:
        """Log frames of a stream, see `frames.observe_frames`. Blocking: use it in a thread."""
        return observe_frames(self._log, frames)

    async def log_frames(self, model: str, make: Callable[[], Frames], arrived: float) -> FramesResult:
        """Log frames of a stream in a thread, in order of arrival; see `IngestThreads.run`."""
        return await self.threads.run(model, lambda: self.observe_frames(make()), arrived=arrived)

    def monitor(self, model: str) -> Monitor:
        """Return the monitor of a model, up to date with batches that other services have logged.

        Raise NotFoundError or UnreadableVersionError. Blocking: use it in a thread.
        """
        monitor = self._monitor(self.loaded.get(model, None))
        self._log.follow(monitor, model)
        return monitor

    def turn(self, model: str) -> AbstractContextManager[None]:
        """Lock a model's log, see `ObservationLog.turn`; raise as `monitor` does. Blocking: use it in a thread."""
        return self._log.turn(self._monitor(self.loaded.get(model, None)), model)

    def follow(self, models: Collection[str] | None = None) -> None:
        """Update the monitors of these models from the log; None: of all models in memory.

        Blocking: use it in a thread.
        """
        if models is None:
            self.load_monitors()
        else:
            for model in models:
                self.monitor(model)

    def monitors(self) -> dict[str, Monitor]:
        """Return the monitors that exist: of models that have learnt or were shown since the service started."""
        with self._lock:
            return dict(self._monitors)

    def load_monitors(self) -> dict[str, Monitor]:
        """Return the monitors that exist and those of models in memory that have streams, by model.

        No model is loaded, because that would unload another. Blocking: use it in a thread.
        """
        with self.database.session() as session:
            learning = list(session.scalars(select(StreamRow.model).distinct()))
        fresh = {}
        for model in learning:
            if (served := self.loaded.peek(model)) is not None:
                fresh[model] = self._monitor(served)
                self._log.follow(fresh[model], model)
        return dict(sorted((self.monitors() | fresh).items()))

    def retain(self) -> None:
        """Delete the observations of all models beyond the limits, and silent streams. Blocking: use it in a thread.

        Batches do this too, but a model may receive none for long, or few between two starts of the service.
        """
        with self.database.session() as session:
            logged = list(session.scalars(select(ModelRow.name)))
        known = self.monitors()
        for model in logged:
            self._log.retain(model, known.get(model))

    def forget(self, model: str) -> None:
        """Delete everything about a model that has been deleted."""
        self.live.forget(model)
        self.weighing.forget(model)
        with self._lock:
            self._monitors.pop(model, None)
            self._status = {key: status for key, status in self._status.items() if key[0] != model}

    def check_process(self, lasting: FaultAge) -> tuple[PartState, str]:
        """Return the readiness of the learner process. Blocking: use it in a thread.

        Rows that wait are only a warning: one version that cannot learn does not affect other models or answers.
        """
        if not self.process.is_needed:
            return "ok", "not needed yet"
        gone = lasting(self.process.pid is None)
        if gone is not None and gone <= RESTART_S:
            return "warning", "is starting"
        if gone is not None:
            return "failed", texts.describe_process_gone(gone)
        if (silent_s := self.process.silent_s) > RESTART_S:
            return "failed", texts.describe_process_silent(silent_s)
        behind, stands = self._behind()
        waited = lasting(stands, "lag")
        if waited is not None and waited > MAX_LAG_S:
            return "warning", texts.describe_lag(behind, waited)
        return "ok", "runs"

    def _behind(self) -> tuple[int, bool]:
        """Return how many events serving versions must still learn, and whether one has learnt none lately.

        Lately is since the last call.
        """
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

    def lag(self, served: ServedModel) -> Lag:
        """Return how far the answers of a version lag behind. Blocking: use it in a thread."""
        model = served.name
        with self.database.session() as session:
            contained = log.start_of(session, model, served.version) + served.revision
            rows, arrived = log.count_pending(session, model, contained)
        waited = 0.0 if arrived is None else max(time.time() - arrived, 0.0)
        return Lag(rows, max(waited, self.threads.wait_s(model)))

    def status(self, model: str, version: int) -> LearnerStatus:
        """Return the learner process's latest messages about a version."""
        with self._lock:
            return self._status.get((model, version), LearnerStatus())

    def _monitor(self, served: ServedModel) -> Monitor:
        """Return the monitor of a model. It is made on first use, and again if a version has other joints."""
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

    def _update_status(self, message: Publication | LearningFailure, **latest: Any) -> None:
        key = message.model, message.version
        with self._lock:
            self._status[key] = replace(self._status.get(key, LearnerStatus()), **latest)

    def _receive(self, message: Message) -> None:
        """Act on a message of the learner process, in its reader's thread."""
        if isinstance(message, Publication):
            # replaces an immutable revision: answers in flight keep theirs
            self.loaded.revise(message.model, message.version, message.revision, publication.read(message.path))
            self._update_status(message, published=message, failed=None)
            for call in self.on_published:
                call(message)
        elif isinstance(message, LearningFailure):
            logger.error("version %s of model %s cannot learn: %s", message.version, message.model, message.error)
            self._update_status(message, failed=message)
