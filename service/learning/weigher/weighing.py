"""The payloads of streams as the service sees them.

Rows go to the weigher process. A payload that it notices is used for answers at once, then logged.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from sqlalchemy import select

from lipcore.online.payload.holding import PayloadTracker
from lipcore.online.screening import PredictedBatch
from lipcore.online.stream import PayloadRecord
from service.foundation.errors import ServiceError
from service.journal import log, undo
from service.journal.alarms import raise_alarm
from service.journal.arrivals import NewBatch
from service.learning import texts
from service.learning.ingest.monitor import Monitor
from service.learning.weigher.messages import (
    MAX_STREAMS,
    Message,
    PosteriorUpdate,
    Stream,
    StreamRows,
    UnknownStream,
    WatchUpdate,
)
from service.learning.weigher.process import MAX_WAITING_BATCHES, WeigherProcess
from service.models.loaded import LoadedModels, ServedModel
from service.storage.database import EventRow

logger = logging.getLogger(__name__)

MIN_ALARM_PAUSE_S = 60.0
"""Min seconds between two payload alarms of a model, and between two warnings that the process is behind.

A robot that picks and places would raise alarms all day.
"""


class Weighing:
    """Follows the payloads of the streams of all models; safe from several threads.

    process: the weigher process. monitor, turn: see `ObservationLog`.
    """

    def __init__(
        self,
        loaded: LoadedModels,
        monitor: Callable[[ServedModel], Monitor],
        turn: Callable[[Monitor, str], AbstractContextManager[None]],
    ) -> None:
        self.loaded, self.database = loaded, loaded.storage.database
        self._monitor, self._turn = monitor, turn
        self.process = WeigherProcess(loaded.storage.settings, self.handle_message)
        self._lock = threading.Lock()
        self._behind_at = -MIN_ALARM_PAUSE_S  # Unix time of the last warning that the process is behind, s
        self._sent: dict[Stream, tuple[int, int]] = {}  # epoch of the process and event of the payload sent to it
        self._revisions: dict[tuple[str, int], tuple[int, int]] = {}  # epoch of the process and revision sent to it

    def close(self) -> None:
        """End the process."""
        self.process.close()

    def expect(self) -> None:
        """Prepare the process for streams of the serving versions.

        A process that starts only when their first rows arrive is seconds late.
        """
        for model, version in self.loaded.versions_in_use():
            served = self.loaded.peek(model)
            if served is not None and served.version == version and served.carrier is not None:
                self.process.queue_work((model, version, ""))

    def follow(self, monitor: Monitor, served: ServedModel, batch: NewBatch, screened: PredictedBatch) -> None:
        """Send a logged batch to the process, in the model's turn. Never waits for the process."""
        assert served.carrier is not None
        rows = screened.rows.take(screened.answerable)
        if not len(rows):
            return
        stream, version = (served.name, served.version, batch.stream_id), (served.name, served.version)
        event, epoch = monitor.payloads.find_event(batch.stream_id), self.process.epoch
        with self._lock:
            if len(self._sent) > MAX_STREAMS:  # resends what the process may still know
                self._sent.clear()
            has_payload = self._sent.get(stream) == (epoch, event)
            has_posterior = self._revisions.get(version) == (epoch, served.revision)
            self._sent[stream], self._revisions[version] = (epoch, event), (epoch, served.revision)
        watch = update = None
        if not has_payload:
            watch = monitor.payloads.watch(batch.stream_id, served.carrier, served.version).outline()
        if not has_posterior:
            posterior = served.model.posterior
            update = PosteriorUpdate(posterior.weights, posterior.root)
        if self.process.queue_work(
            stream, StreamRows(rows, batch.received, event, update, watch), most=MAX_WAITING_BATCHES
        ):
            self._forget_sent(stream)  # the dropped batch may have carried the state
            if batch.received - self._behind_at >= MIN_ALARM_PAUSE_S:
                self._behind_at = batch.received
                text = (
                    "rows come faster than payloads are estimated: the oldest are skipped, now of stream %r of model %s"
                )
                logger.warning(text, batch.stream_id, served.name)

    def forget(self, model: str) -> None:
        """Delete everything about a model that has been deleted."""
        with self._lock:
            self._sent = {stream: each for stream, each in self._sent.items() if stream[0] != model}
            self._revisions = {version: each for version, each in self._revisions.items() if version[0] != model}
        if self.process.is_needed:
            self.process.queue_work(model)

    def handle_message(self, message: Message) -> None:
        """Act on a message of the process, in its reader's thread."""
        if isinstance(message, UnknownStream):
            self._forget_sent(message.stream)
            return
        model, version, stream_id = message.stream
        served = self.loaded.snapshot.versions_of(model).get(version)
        if served is None or served.carrier is None:
            return
        monitor = self._monitor(served)
        before = monitor.payloads.watch(stream_id, served.carrier, version)
        if not monitor.payloads.store(stream_id, message.watch, version, message.received, message.event):
            return
        served.payloads.replace(monitor.payloads.build_models(served.carrier, version))
        if (before.held is None, before.since) == (message.watch.held is None, message.watch.since):
            return
        try:
            self._log_payload(monitor, served, message)
        except ServiceError as error:  # answers use the payload anyway, and the report of the next batch contains it
            logger.error("could not log the payload of stream %r of model %r: %s", stream_id, model, error)

    def _forget_sent(self, stream: Stream) -> None:
        """Mark a stream as not sent, so that its next rows carry its payload and posterior."""
        with self._lock:
            self._sent.pop(stream, None)
            self._revisions.pop(stream[:2], None)

    def _log_payload(self, monitor: Monitor, served: ServedModel, message: WatchUpdate) -> None:
        """Log a payload that was picked up or put down. Unlearn the rows since a pick-up."""
        model, _, stream_id = message.stream
        watch, database = message.watch, self.database
        with self._turn(monitor, model):
            if monitor.payloads.find_event(stream_id) != message.event:
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
                if message.received - monitor.payload_alarm_at >= MIN_ALARM_PAUSE_S:
                    monitor.payload_alarm_at = message.received
                    text, mass = _describe_watch(stream_id, watch)
                    evidence = {"stream_id": stream_id, "at": watch.since, **mass}
                    raise_alarm(session, model, "payload", text, evidence, clears=watch.held is None)
            monitor.number = event.number
            monitor.streams.change(stream_id, scale=None)  # errors during the change do not calibrate its intervals
            served.scales.replace(monitor.streams.factors(served.version))
        self.loaded.wake(model)  # the next batch may be hours away


def _describe_watch(stream_id: str, watch: PayloadTracker) -> tuple[str, dict[str, object]]:
    """Return the text of an alarm and its evidence."""
    if watch.held is None:
        return texts.describe_put_down(stream_id), {}
    mean, std = watch.held.estimate.mass
    return texts.describe_payload(stream_id, mean, std), {"mass": {"mean": mean, "std": std}}
