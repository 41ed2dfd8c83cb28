"""Where batches and frames are written down: judged in turn, and durable before they are acknowledged."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import case, func, select, update
from sqlalchemy.orm import Session

from lipcore.online import judging
from lipcore.online.batch import AHEAD_S, Rows
from lipcore.online.judging import JudgeOptions, Verdict
from lipcore.online.screening import Screened
from lipcore.vocabulary import CODES
from service.contract.observations import LearningOptions
from service.foundation.errors import ConflictError, not_found
from service.journal import log
from service.journal.log import NewBatch
from service.journal.snapshots import retain
from service.learning import intervals, owner
from service.learning.ingest import alarms
from service.learning.ingest.dating import LEAP_S
from service.learning.ingest.host_clock import HostClock
from service.learning.ingest.monitor import Monitor
from service.learning.intervals import ScaleRecord
from service.learning.streams import StreamRecord
from service.learning.weigher.weighing import Weighing
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.storage.database import ModelRow, StreamRow

logger = logging.getLogger(__name__)

ACCEPTED = tuple(CODES.index(code) for code in ("learnt", "stationary", "payload"))
"""Codes of rows that are not kept out: the model, with the payload it knows of, is to explain them."""

MAX_STREAMS = 1000
"""Streams of a model; a new one takes the place of the longest silent."""
RETAIN_EVERY = 200
"""Batches of a model after which its log is brought within its limits."""
ROW_NUMBERS, NUMBER_BYTES = 6, 8
"""What a row takes of the disk, for each joint: motion and torque, and half as much again for times and indices."""
MOST_GAPS = 100
"""Gaps that an acknowledgement names."""


class Judged(NamedTuple):
    """A batch that is durable, for those who follow its model live. rows: with their final codes."""

    served: Served
    stream_id: str
    rows: Rows
    screened: Screened


class Intake:
    """Appends observations to the logs of models; safe from several threads, not for the event loop.

    monitor: gives the monitor of a model that is served; monitors: those that there are. wake: tells the learner
    process that a model's log has grown. show: called with each batch once it is durable. weighing: follows what arms
    carry.
    """

    def __init__(
        self,
        loaded: LoadedModels,
        monitor: Callable[[Served], Monitor],
        monitors: Callable[[], Mapping[str, Monitor]],
        wake: Callable[[str], None],
        show: Callable[[Judged], None],
    ) -> None:
        storage = loaded.storage
        self.settings, self.database, self.disk = storage.settings, storage.database, storage.disk
        self.loaded, self.monitor, self._monitors = loaded, monitor, monitors
        self._wake, self._show = wake, show
        self.weighing = Weighing(loaded, monitor, self.turn)
        self._host, self._host_lock = HostClock(), threading.Lock()

    def arrival(self) -> float:
        """Return the time of a batch that arrives now, Unix time, s. If the host's clock was set, first move what is
        dated by it."""
        with self._host_lock:
            step = self._host.step()
            if step:
                logger.warning("the clock of this machine was set by %+.1f s", step)
                self.set_clock(step)
        return time.time()

    def set_clock(self, step: float) -> None:
        """Take what is dated by this machine's clock to a clock that was set by `step`, s. Where several services share
        the database, streams are dated by the clocks of others, too, and stay as they are."""
        if not self.database.shared:
            offset = case((StreamRow.offset == 0, 0.0), else_=StreamRow.offset + step)
            with self.database.transaction() as session:
                session.execute(update(StreamRow).values(offset=offset, received=StreamRow.received + step))
        for monitor in self._monitors().values():
            with monitor.lock:
                monitor.set_clock(step)

    def check_clock_at_start(self) -> None:
        """Move streams to the host's clock if it was set back while no service ran; before the first batch."""
        with self.database.session() as session:
            newest = session.scalar(select(func.max(StreamRow.received)))
        if newest is not None and (step := time.time() - newest) < -LEAP_S and not self.database.shared:
            logger.warning("the clock of this machine was set by %+.1f s while no service ran", step)
            self.set_clock(step)

    @contextmanager
    def turn(self, monitor: Monitor, model: str) -> Iterator[None]:
        """Have a model's log alone, among all threads and services; its monitor is up to the log by then. Raise
        StorageUnavailableError where the turn does not come within `database_timeout_s`."""
        # the turn first: who only looks at the monitor does not wait for other services
        with self.database.turn(model), monitor.lock:
            self._follow(monitor, model)
            yield

    def follow(self, monitor: Monitor, model: str) -> None:
        """Bring a monitor up to the batches that other services have logged."""
        if self.database.shared:
            with monitor.lock:
                self._follow(monitor, model)

    def _follow(self, monitor: Monitor, model: str) -> None:
        if self.database.shared:
            known = monitor.number
            with self.database.session() as session:
                monitor.follow(session, model)
                kept = owner.options(session, model).adaptive_intervals
            if monitor.number != known:
                for version, served in self.loaded.served(model).items():
                    if served.carrier is not None:
                        served.loads.take(monitor.payloads.carried(served.carrier, version))
            for version, scales in self.loaded.scales(model).items():
                scales.take(monitor.streams.factors(version) if kept else {})

    def append(
        self,
        monitor: Monitor,
        served: Served,
        options: LearningOptions,
        batch: NewBatch,
        screened: Screened,
        details: dict[str, Any],
    ) -> dict[str, Any]:
        """Judge a batch and log it with all that follows from it, in one transaction, in a `turn` of its model. Return
        the report that the log keeps of it: `details`, and what every report has. The batch is durable then."""
        model = served.name
        rows = screened.own.stop - screened.own.start
        self.disk.take(ROW_NUMBERS * NUMBER_BYTES * served.model.n_joints * rows)
        streams, stream_id = monitor.streams, batch.stream_id
        watch = None
        if served.carrier is not None and options.payloads:
            watch = monitor.payloads.watch(stream_id, served.carrier, served.version)
        with self.database.transaction(model) as session:
            _check_kept(session, served)
            held = owner.held(session, model) is not None
            if monitor.held and not held:
                monitor.decided()
                streams.change_all(session, model, StreamRecord.decided)
            usual = partial(monitor.usual, batch.received)
            since = None if watch is None or watch.held is None else watch.since
            new = log.stream(session, model, stream_id) is None
            if new:
                streams.forget(stream_id)  # one of this name that has made room for others
            verdict = judging.judge(
                screened,
                monitor.watch(stream_id, new),
                held,
                JudgeOptions(options.enabled, options.on_change, options.contact_threshold),
                usual,
                batch.received,
                since,
                served.base.scale,
            )
            if verdict.change is not None and options.on_change == "adapt" and not held:
                log.append(session, model, "change", {"t": verdict.change.at}, batch.received)
            scale, answered = _scaled(monitor, served, options, stream_id, screened, verdict)
            record = None if verdict.record is None else verdict.record.to_json()
            judged = replace(batch, rows=verdict.rows, record=record)
            start = log.start_of(session, model, served.version)
            event = log.append_batch(session, model, judged, MAX_STREAMS)
            event.rows = rows  # without those that had waited, which other batches count
            source = log.stream(session, model, stream_id)
            assert source is not None
            alarms.apply_verdict(session, served, "waits" if held else options.on_change, verdict, event)
            leap = details.get("leap")
            if leap is not None and not streams.get(stream_id).leapt:
                alarms.raise_clock_alarm(session, model, stream_id, leap)
            doubted = verdict.held and (verdict.opened is not None or streams.get(stream_id).doubted)
            known: dict[str, Any] = {"begun": event.number} if new else {}
            known |= {
                "gate": verdict.watch.gate,
                "opening": verdict.watch.opening,
                "doubted": doubted,
                "scale": scale,
                "leapt": leap is not None,
                "received": batch.received,
            }
            source.record = replace(streams.get(stream_id), **known).to_json()
            report = details | {
                "model": model,
                "version": served.version,
                "revision": event.number - start,
                "stream_id": stream_id,
                "sequence": batch.sequence,
                "rows": rows,
                "accepted": event.learnt,
                "effective_samples": _effective(verdict.rows.learnt, batch.received, options.forgetting_s),
                "duplicate": False,
                "state": "learnt",
                "rejected": verdict.rows.rejected(),
                "gaps": [list(pair) for pair in source.missing["ranges"][-MOST_GAPS:]],
                "held": verdict.held,
                # for the batches that follow, for other services, and for one that starts again
                "own": [screened.own.start, screened.own.stop],
                "open": verdict.watch.gate.open,
                "departure": None if verdict.watch.departure is None else verdict.watch.departure.to_json(),
                "waited": held,
                "doubted": doubted,
                "aside": verdict.held or not options.enabled,
                "until": None if screened.until is None else min(screened.until, batch.received + AHEAD_S),
                **answered,
                "surprise": None if verdict.surprise is None else verdict.surprise.tolist(),
            }
            event.report = report
            if new:
                session.flush()
                streams.keep(session, model)
        streams.change(stream_id, **known)
        monitor.note(event, verdict.watch.innovations)
        if watch is not None and served.carrier is not None:
            served.loads.take(monitor.payloads.carried(served.carrier, served.version))
            self.weighing.follow(monitor, served, batch, screened)
        served.scales.take(streams.factors(served.version) if options.adaptive_intervals else {})
        self._show(Judged(served, stream_id, verdict.rows, screened))
        return report

    def follow_up(self, monitor: Monitor, model: str) -> None:
        """Wake the learner for a batch that is durable; every RETAIN_EVERY batches, bring the log within its limits and
        delete streams that have long been silent."""
        self._wake(model)
        if monitor.due(RETAIN_EVERY):
            try:
                retain(self.database, self.settings, model, time.time())
                with self.turn(monitor, model), self.database.transaction(model) as session:
                    monitor.streams.expire(session, model, time.time() - self.settings.observation_retention_s)
            except Exception as error:  # the batch is logged all the same
                logger.error("the log of model %s was not brought within its limits", model, exc_info=error)


def _scaled(
    monitor: Monitor, served: Served, options: LearningOptions, stream_id: str, screened: Screened, verdict: Verdict
) -> tuple[ScaleRecord | None, dict[str, Any]]:
    """Return the scale of a stream's intervals after a batch, None if not adaptive, and its part of the report."""
    seen = screened.seen
    if not options.adaptive_intervals or seen is None:
        return None, {}
    scale = monitor.scale(stream_id, served.version, served.base.scale)
    report = {"answered": intervals.inside(scale.state, seen)}
    # other errors were of the arm without what it carries, or with what it no longer does
    if screened.answered is None:
        scale = scale.step(seen, np.isin(verdict.rows.code[screened.asked], ACCEPTED))
    return scale, {**report, "accepted_scale": scale.accepted.to_json()}


def _check_kept(session: Session, served: Served) -> None:
    """Raise an error where a model, or the version that has predicted a batch, has been deleted meanwhile."""
    if registry.exists(session, served.name, served.version):
        return
    if session.scalar(select(ModelRow.name).where(ModelRow.name == served.name)) is None:
        raise not_found("model", served.name)
    raise ConflictError(f"version {served.version} of model {served.name!r} was deleted meanwhile: send it again")


def _effective(rows: Rows, received: float, forgetting_s: float | None) -> float:
    """Independent samples that rows count as when they come."""
    if forgetting_s is None:
        return float(rows.weight.sum())
    return float((rows.weight * np.exp(np.minimum(rows.time - received, 0.0) / forgetting_s)).sum())
