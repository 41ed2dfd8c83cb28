"""What a running service holds to learn while it serves: monitors of models, and the learner process."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Annotated, Any

from fastapi import Depends, Request

from service.foundation.states import PartState
from service.learning.ingest.frames import Frames, FramesResult, observe_frames
from service.learning.ingest.intake import Ingest
from service.learning.ingest.threads import IngestThreads
from service.learning.learner import publication
from service.learning.learner.messages import Contested, Failed, Message, Published
from service.learning.learner.process import LearnerProcess, learner_place
from service.learning.live.feed import Feed
from service.learning.quality.monitor import Monitor
from service.learning.schema import ObservationRequest, ObservationResponse
from service.models.loaded import LoadedModels, Served
from service.web.observability.readiness import Lasting

__all__ = ["Frames", "FramesResult", "Status", "Updates"]
logger = logging.getLogger(__name__)

RESTART_S = 10.0
"""Time in s within which a learner process that died should have been started again."""


@dataclass(frozen=True)
class Status:
    """What the learner process said last of a version, since the service started; None until it does."""

    published: Published | None = None
    failed: Failed | None = None


class Updates:
    """Learning of all models; safe from several threads. Close it before the database.

    learner: the process that learns. threads: which take batches. live: who follows models. when_published,
    when_contested: called with each such message of the learner, in a thread of its own, after a revision answers; to
    be filled before the first batch comes.
    """

    def __init__(self, loaded: LoadedModels) -> None:
        storage = loaded.storage
        settings, database = storage.settings, storage.database
        self.settings, self.database, self.loaded = settings, database, loaded
        self.when_published: list[Callable[[Published], None]] = []
        self.when_contested: list[Callable[[Contested], None]] = []
        self.threads = IngestThreads(learner_place(settings))
        self._lock = threading.Lock()
        self._monitors: dict[str, Monitor] = {}
        self._said: dict[tuple[str, int], Status] = {}
        self.learner = LearnerProcess(settings, self._hear)
        loaded.learn_from(self.learner.wake)
        loaded.when_deleted.append(self.forget)
        self.live = Feed(settings)
        self._ingest = Ingest(
            settings, database, loaded, self._monitor, self.learner.wake, storage.disk, self.live.note
        )

    def close(self) -> None:
        """Finish the batches that have begun, and end the learner process, which stores what it knows."""
        self.threads.close()
        self.learner.close()

    def observe(self, model: str, request: ObservationRequest) -> ObservationResponse:
        """Take a batch of observations; see `Ingest.observe`. Not for the event loop."""
        return self._ingest.observe(model, request)

    def observe_frames(self, frames: Frames) -> FramesResult:
        """Take frames of a stream; see `frames.observe_frames`. Not for the event loop."""
        return observe_frames(self._ingest, self._monitor(frames.served), frames)

    def monitor(self, model: str) -> Monitor:
        """What is kept in memory of a model; raise NotFoundError or UnreadableVersionError. Not for the event loop.

        It knows what other services took by now too.
        """
        found = self._monitor(self.loaded.get(model, None))
        self._ingest.follow(found, model)
        return found

    def turn(self, model: str) -> AbstractContextManager[None]:
        """Be the only one, of all services, that takes something for a model; raise as `monitor`. Not for the event
        loop."""
        return self._ingest.turn(self._monitor(self.loaded.get(model, None)), model)

    def follow(self) -> None:
        """Take in what other services took for the models that are known here. Not for the event loop."""
        for model, monitor in self.monitors().items():
            self._ingest.follow(monitor, model)

    def monitors(self) -> dict[str, Monitor]:
        """Those of the models that have learnt or have been looked at since the service started."""
        with self._lock:
            return dict(self._monitors)

    def forget(self, model: str) -> None:
        """Keep nothing of a model that has been deleted."""
        with self._lock:
            self._monitors.pop(model, None)
            self._said = {key: status for key, status in self._said.items() if key[0] != model}

    def look(self, lasting: Lasting) -> tuple[PartState, str]:
        """Whether the learner process runs where something learns, for readiness."""
        if not self.learner.wanted:
            return "ok", "not needed yet"
        gone = lasting(self.learner.pid is None)
        if gone is None:
            return "ok", "runs"
        if gone <= RESTART_S:
            return "warning", "is being started"
        return "failed", f"has not run for {gone:.0f} s: observations are stored, but not learnt"

    def status(self, model: str, version: int) -> Status:
        """What the learner process said last of a version."""
        with self._lock:
            return self._said.get((model, version), Status())

    def _monitor(self, served: Served) -> Monitor:
        """The monitor of a model, made when it is first needed, or when another version has other joints."""
        with self._lock:
            found = self._monitors.get(served.name)
            if found is None or found.joint_names != served.model.joint_names:
                with self.database.session() as session:
                    names = served.model.joint_names
                    made = Monitor.rebuilt(session, served.name, names, self.settings, time.time())
                if found is not None:
                    made.lock = found.lock  # batches of a model are logged one at a time, whatever its joints
                found = self._monitors[served.name] = made
            return found

    def _note(self, message: Published | Failed, **said: Any) -> None:
        key = message.model, message.version
        with self._lock:
            self._said[key] = replace(self._said.get(key, Status()), **said)

    def _hear(self, message: Message) -> None:
        """Act on what the learner process says; called in its reader's thread."""
        if isinstance(message, Published):
            self._publish(message)
            for tell in self.when_published:
                tell(message)
        elif isinstance(message, Contested):
            for call in self.when_contested:
                call(message)
        elif isinstance(message, Failed):
            logger.error("version %s of model %s does not learn: %s", message.version, message.model, message.error)
            self._note(message, failed=message)

    def _publish(self, message: Published) -> None:
        """Answer with what a version has learnt."""
        revision = publication.read(message.path)
        self.loaded.revise(message.model, message.version, message.revision, revision)
        self._note(message, published=message, failed=None)


async def _updates(request: Request) -> Updates:
    found: Updates = request.app.state.updates
    return found


UpdatesDep = Annotated[Updates, Depends(_updates)]
