"""The append of batches and frames to the log: judged in turn, and durable before they are acknowledged."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.kernels.drive.play import PlayState, element_widths
from lipcore.online.batch import Placement, Rows
from lipcore.online.judging import Judgement, JudgeOptions, judge
from lipcore.online.screening import PredictedBatch
from lipcore.online.stream import StreamRecord
from service.contract.observations import Derivation, LearningOptions, ObservationResponse
from service.foundation.errors import ConflictError, not_found
from service.journal import log
from service.journal.arrivals import NewBatch
from service.journal.snapshots import retain
from service.learning import owner
from service.learning.ingest import consequences
from service.learning.ingest.clock import StreamClocks
from service.learning.ingest.monitor import Monitor
from service.learning.streams import Streams
from service.learning.weigher.weighing import Weighing
from service.models import registry
from service.models.loaded import LoadedModels, ServedModel
from service.storage.database import EventRow, ModelRow, StreamRow

logger = logging.getLogger(__name__)

MAX_STREAMS = 1000
"""Max streams of a model. A new one replaces the one that was silent longest."""
RETAIN_EVERY = 200
"""Batches of a model between two runs of retention."""
NUMBERS_PER_ROW = 6
"""Disk space of a row for each joint, in numbers: motion and torque, and half as much for times and indices."""
MAX_GAPS = 100
"""Max gaps that an acknowledgement contains."""


class LoggedBatch(NamedTuple):
    """A durable batch, for the live feed. rows: with their final codes."""

    served: ServedModel
    stream_id: str
    rows: Rows
    screened: PredictedBatch


class Arrival(NamedTuple):
    """A batch that is yet to be judged."""

    batch: NewBatch
    predicted: PredictedBatch
    first: bool
    """Whether it is the first batch of its stream."""
    place: Placement
    """Its place in the stream."""
    derived: Derivation | None = None
    """The quantities that were derived; None if all were measured."""
    leap: float | None = None
    """Seconds that the stream's clock has leapt ahead; None if it has not."""
    play: PlayState | None = None
    """The deflections after its last row; None if later rows of the stream came before, or the model has none."""


class FollowedRows(NamedTuple):
    """Rows with their deflections. play: those after the last row; None for late rows, and if the model has none."""

    rows: Rows
    play: PlayState | None


class ObservationLog:
    """Appends observations to the logs of models; safe from several threads. Blocking: use it in a thread.

    - monitor: returns the monitor of a served model.
    - monitors: returns the existing monitors by model.
    - wake: notifies the learner process that a model's log has grown.
    - show: called with each durable batch.
    - weighing: follows payloads.
    """

    def __init__(
        self,
        loaded: LoadedModels,
        monitor: Callable[[ServedModel], Monitor],
        monitors: Callable[[], Mapping[str, Monitor]],
        wake: Callable[[str], None],
        show: Callable[[LoggedBatch], None],
    ) -> None:
        storage = loaded.storage
        self.settings, self.database, self.disk = storage.settings, storage.database, storage.disk
        self.loaded, self.monitor, self._wake, self._show = loaded, monitor, wake, show
        self.clocks = StreamClocks(storage.database, monitors)
        self.weighing = Weighing(loaded, monitor, self.turn)

    @contextmanager
    def turn(self, monitor: Monitor, model: str) -> Iterator[None]:
        """Lock a model's log against all threads and services, and update its monitor from the log.

        Raise StorageUnavailableError if the lock is not acquired in time.
        """
        # the turn first: readers of the monitor then do not wait for other services
        with self.database.turn(model), monitor.lock:
            with self.database.session() as session:
                if monitor.follow(session, model):
                    self._publish(session, monitor, model)
            yield

    def follow(self, monitor: Monitor, model: str) -> None:
        """Update a monitor from the log."""
        with monitor.lock, self.database.session() as session:
            monitor.follow(session, model)
            self._publish(session, monitor, model)

    def _publish(self, session: Session, monitor: Monitor, model: str) -> None:
        """Set the payloads and interval factors of a model's streams on all of its versions."""
        adaptive = owner.read_options(session, model).adaptive_intervals
        for version, served in self.loaded.snapshot.versions_of(model).items():
            if served.carrier is not None:
                served.payloads.replace(monitor.payloads.build_models(served.carrier, version))
        for version, scales in self.loaded.scales(model).items():
            scales.replace(monitor.streams.factors(version) if adaptive else {})

    def append(
        self, monitor: Monitor, served: ServedModel, options: LearningOptions, arrival: Arrival
    ) -> ObservationResponse:
        """Judge a batch and log it with its consequences in one transaction, in a `turn` of its model.

        The batch is durable once this returns.
        """
        batch, predicted = arrival.batch, arrival.predicted
        model, stream_id, streams = served.name, batch.stream_id, monitor.streams
        self.disk.reserve(NUMBERS_PER_ROW * np.dtype(np.float64).itemsize * predicted.rows.q[predicted.own].size)
        watch = None
        if served.carrier is not None and options.payloads:
            watch = monitor.payloads.watch(stream_id, served.carrier, served.version)
        carried = None if watch is None or watch.held is None else watch.since
        with self.database.transaction(model) as session:
            _check_exists(session, served)
            monitor.follow_decision(session, model)
            before = monitor.stream(stream_id, arrival.first)
            judgement = judge(
                predicted,
                before,
                monitor.record,
                _judge_options(options),
                lambda: monitor.read_latest_record(batch.received),
                batch.received,
                carried,
            )
            event, answer, after = _write(session, served, options, arrival, before, judgement)
            if arrival.first:
                session.flush()
                streams.drop_deleted(session, model)
        streams.store_judged(stream_id, after)
        monitor.add_batch(event, judgement)
        if watch is not None and served.carrier is not None:
            served.payloads.replace(monitor.payloads.build_models(served.carrier, served.version))
            self.weighing.follow(monitor, served, batch, predicted)
        served.scales.replace(streams.factors(served.version) if options.adaptive_intervals else {})
        self._show(LoggedBatch(served, stream_id, judgement.rows, predicted))
        return answer

    def follow_up(self, monitor: Monitor, model: str) -> None:
        """Wake the learner for a durable batch.

        Every `RETAIN_EVERY` batches, run retention and delete streams that have long been silent.
        """
        self._wake(model)
        if monitor.due(RETAIN_EVERY):
            self.retain(model, monitor)

    def retain(self, model: str, monitor: Monitor | None) -> None:
        """Delete the observations of a model beyond the limits, and its streams that have long been silent.

        monitor: of the model, None if it has none yet.
        """
        try:
            retain(self.database, self.settings, model, time.time())
            turn = self.database.turn(model) if monitor is None else self.turn(monitor, model)
            with turn, self.database.transaction(model) as session:
                streams = Streams.restored(session, model) if monitor is None else monitor.streams
                streams.expire(session, model, time.time() - self.settings.observation_retention_s)
        except Exception as error:  # batches are logged nevertheless
            logger.error("could not delete old batches from the log of model %s", model, exc_info=error)


def follow_rows(
    monitor: Monitor, served: ServedModel, stream_id: str, source: StreamRow | None, sequence: int, rows: Rows
) -> FollowedRows:
    """Return rows with the deflections that follow from the stream's earlier rows. In a `turn` of the model.

    The motion before late rows is unknown. source: row of the stream, None if it is new; sequence: of the first row.
    Rows of models that remember nothing are logged without deflections, which earlier releases cannot read.
    """
    if not served.model.remembers:
        return FollowedRows(rows, None)
    late = source is not None and sequence <= source.last
    before = None if source is None or late else monitor.streams.get(stream_id).play
    state = PlayState.unknown(served.model.n_joints) if before is None else before
    followed, after = rows.followed(state, element_widths(served.model.joint_types))
    return FollowedRows(followed, None if late else after)


def _judge_options(options: LearningOptions) -> JudgeOptions:
    return JudgeOptions(options.enabled, options.on_change, options.contact_threshold, options.adaptive_intervals)


def _check_exists(session: Session, served: ServedModel) -> None:
    """Raise an error if a model, or the version that predicted a batch, has been deleted meanwhile."""
    if registry.exists(session, served.name, served.version):
        return
    if session.scalar(select(ModelRow.name).where(ModelRow.name == served.name)) is None:
        raise not_found("model", served.name)
    raise ConflictError(f"version {served.version} of model {served.name!r} was deleted meanwhile: send it again")


def _write(
    session: Session,
    served: ServedModel,
    options: LearningOptions,
    arrival: Arrival,
    before: StreamRecord,
    judgement: Judgement,
) -> tuple[EventRow, ObservationResponse, StreamRecord]:
    """Log a batch, its stream's record and its consequences; return the event, the response and the record."""
    batch, logged, model = arrival.batch, judgement.logged, served.name
    if judgement.change is not None and options.on_change == "adapt" and not logged.waited:
        log.append(session, model, "change", {"t": judgement.change.at}, batch.received)
    start = log.start_of(session, model, served.version)
    record = None if judgement.record is None else judgement.record.to_json()
    event, source = log.append_batch(session, model, replace(batch, rows=judgement.rows, record=record), MAX_STREAMS)
    event.rows = len(arrival.predicted.rows.q[arrival.predicted.own])  # adjacent batches count the others
    consequences.apply_judgement(session, served, options, judgement, event)
    if arrival.leap is not None and not before.leapt:
        consequences.raise_clock_alarm(session, model, batch.stream_id, arrival.leap)
    begun = event.number if arrival.first else before.begun
    play = before.play if arrival.play is None else arrival.play
    after = replace(judgement.stream, leapt=arrival.leap is not None, begun=begun, play=play)
    source.record = after.to_json()
    answer = ObservationResponse(
        model=model,
        version=served.version,
        revision=event.number - start,
        stream_id=batch.stream_id,
        sequence=batch.sequence,
        rows=event.rows,
        accepted=event.learnt,
        effective_samples=_effective(judgement.rows.learnt, batch.received, options.forgetting_s),
        duplicate=False,
        state="learnt",
        rejected=judgement.rows.rejected(),
        gaps=[list(pair) for pair in source.missing["ranges"][-MAX_GAPS:]],
        derived=arrival.derived,
        held=logged.held,
    )
    event.report = answer.model_dump() | arrival.place.to_json() | logged.to_json()
    return event, answer, after


def _effective(rows: Rows, received: float, forgetting_s: float | None) -> float:
    """Return the effective samples of rows at their arrival."""
    if forgetting_s is None:
        return float(rows.weight.sum())
    return float((rows.weight * np.exp(np.minimum(rows.time - received, 0.0) / forgetting_s)).sum())
