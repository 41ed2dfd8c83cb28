"""What streams carry, as the service sees it: rows go to the weigher process, and what it notices is answered with at
once, then logged."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from sqlalchemy import select

from lipcore.online.payload.holding import Watch
from lipcore.online.screening import Screened
from lipcore.online.stream import PayloadRecord
from service.foundation.errors import ServiceError
from service.journal import log, undo
from service.journal.alarms import raise_alarm
from service.journal.arrivals import NewBatch
from service.learning.ingest.monitor import Monitor
from service.learning.weigher.messages import MOST_STREAMS, Asked, Message, Revised, Stream, Unweighed, Weighed
from service.learning.weigher.process import MOST_WAITING, WeigherProcess
from service.models.loaded import LoadedModels, Served
from service.storage.database import EventRow

logger = logging.getLogger(__name__)

ALARM_S = 60.0
"""A robot that picks and places does so all day: of a model, payloads raise no more than one alarm in so long, s; and
a machine that is too slow is told of as often."""


class Weighing:
    """Follows what the streams of all models carry; safe from several threads.

    process: the weigher process. monitor, turn: see `ObservationLog`.
    """

    def __init__(
        self,
        loaded: LoadedModels,
        monitor: Callable[[Served], Monitor],
        turn: Callable[[Monitor, str], AbstractContextManager[None]],
    ) -> None:
        self.loaded, self.database = loaded, loaded.storage.database
        self._monitor, self._turn = monitor, turn
        self.process = WeigherProcess(loaded.storage.settings, self.take)
        self._lock = threading.Lock()
        self._behind_at = -ALARM_S  # Unix time, s, when it was last said that the process is behind
        self._knows: dict[Stream, tuple[int, int]] = {}  # which process, and up to which declaration
        self._revisions: dict[tuple[str, int], tuple[int, int]] = {}  # which process, and which revision

    def close(self) -> None:
        """End the process."""
        self.process.close()

    def expect(self) -> None:
        """Have the process ready for streams of the versions that answer: started with their first rows, it would come
        seconds late."""
        for model, version in self.loaded.held():
            served = self.loaded.peek(model)
            if served is not None and served.version == version and served.carrier is not None:
                self.process.give((model, version, ""))

    def follow(self, monitor: Monitor, served: Served, batch: NewBatch, screened: Screened) -> None:
        """Hand over a batch that is logged; its model's turn is held. Never waits for the process."""
        assert served.carrier is not None
        rows = screened.rows.take(screened.asked)
        if not len(rows):
            return
        stream, version = (served.name, served.version, batch.stream_id), (served.name, served.version)
        said, epoch = monitor.payloads.event(batch.stream_id), self.process.epoch
        with self._lock:
            if len(self._knows) > MOST_STREAMS:  # what the process has not forgotten is told again
                self._knows.clear()
            knows = self._knows.get(stream) == (epoch, said)
            same = self._revisions.get(version) == (epoch, served.revision)
            self._knows[stream], self._revisions[version] = (epoch, said), (epoch, served.revision)
        known = revised = None
        if not knows:
            known = monitor.payloads.watch(batch.stream_id, served.carrier, served.version).outline()
        if not same:
            posterior = served.model.posterior
            revised = Revised(posterior.weights, posterior.root)
        if self.process.give(stream, Unweighed(rows, batch.received, said, revised, known), most=MOST_WAITING):
            self._ask(stream)  # what was dropped may have said what was not known
            if batch.received - self._behind_at >= ALARM_S:
                self._behind_at = batch.received
                text = "rows come faster than payloads are weighed: the oldest are passed over, now of %r of %s"
                logger.warning(text, batch.stream_id, served.name)

    def forget(self, model: str) -> None:
        """Keep nothing of a model that has been deleted."""
        with self._lock:
            self._knows = {stream: each for stream, each in self._knows.items() if stream[0] != model}
            self._revisions = {version: each for version, each in self._revisions.items() if version[0] != model}
        if self.process.needed:
            self.process.give(model)

    def take(self, message: Message) -> None:
        """Act on a message of the process; called in its reader's thread."""
        if isinstance(message, Asked):
            self._ask(message.stream)
            return
        model, version, stream_id = message.stream
        served = self.loaded.served(model).get(version)
        if served is None or served.carrier is None:
            return
        monitor = self._monitor(served)
        before = monitor.payloads.watch(stream_id, served.carrier, version)
        if not monitor.payloads.take(stream_id, message.watch, version, message.received, message.said):
            return
        served.loads.take(monitor.payloads.carried(served.carrier, version))
        if (before.held is None, before.since) == (message.watch.held is None, message.watch.since):
            return
        try:
            self._note(monitor, served, message)
        except ServiceError as error:  # it is answered with, and the next batch's report says so
            logger.error("what stream %r of model %r carries is not logged: %s", stream_id, model, error)

    def _ask(self, stream: Stream) -> None:
        """Say all of a stream with its next rows."""
        with self._lock:
            self._knows.pop(stream, None)
            self._revisions.pop(stream[:2], None)

    def _note(self, monitor: Monitor, served: Served, message: Weighed) -> None:
        """Log what was taken up or put down, and take back what the rows since then have taught."""
        model, _, stream_id = message.stream
        watch, database = message.watch, self.database
        with self._turn(monitor, model):
            if monitor.payloads.event(stream_id) != message.said:
                return
            with database.transaction(model) as session:
                detail = {"stream_id": stream_id, "watch": watch.to_json()}
                if watch.held is not None and not watch.held.declared and watch.since is not None:
                    taught = select(EventRow).where(
                        EventRow.model == model,
                        EventRow.stream_id == stream_id,
                        EventRow.kind == "batch",
                        EventRow.last >= watch.since,
                        EventRow.learnt > 0,
                        EventRow.void.is_(False),
                    )
                    for each in session.scalars(taught.order_by(EventRow.number)).all():
                        undo.unlearn(session, model, each, message.received)
                event = log.append(session, model, "payload", detail, message.received)
                event.stream_id, event.version = stream_id, served.version
                if (source := log.stream(session, model, stream_id)) is not None:
                    payload = PayloadRecord(event.number, message.received, watch.to_json(), served.version)
                    source.record = replace(monitor.streams.get(stream_id), payload=payload, scale=None).to_json()
                if message.received - monitor.payload_alarm_at >= ALARM_S:
                    monitor.payload_alarm_at = message.received
                    text, mass = _told(stream_id, watch)
                    evidence = {"stream_id": stream_id, "at": watch.since, **mass}
                    raise_alarm(session, model, "payload", text, evidence)
            monitor.number = event.number
            monitor.streams.change(stream_id, scale=None)  # its errors on the way say nothing of its intervals
            served.scales.take(monitor.streams.factors(served.version))


def _told(stream_id: str, watch: Watch) -> tuple[str, dict[str, object]]:
    """What an alarm says, and its evidence."""
    if watch.held is None:
        return f"stream {stream_id} has put its payload down", {}
    mean, std = watch.held.estimate.mass
    text = f"stream {stream_id} carries {mean:.2f} ± {std:.2f} kg more than it was trained with"
    return text, {"mass": {"mean": mean, "std": std}}
