"""A batch on its way into the log: identified, checked, predicted, judged, written down in one transaction."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, not_found
from service.foundation.settings import Settings
from service.journal import alarms, log
from service.journal.log import NewBatch, StreamKind
from service.journal.retention import retain
from service.learning import learning
from service.learning.errors import LearningDisabledError
from service.learning.ingest import identity, judging, screening
from service.learning.ingest.clock import Clock
from service.learning.ingest.judging import Verdict
from service.learning.ingest.parsing import Measured, measured
from service.learning.ingest.screening import Screened
from service.learning.learning_options import LearningOptions
from service.learning.live.thinning import Judged
from service.learning.quality.monitor import Monitor
from service.learning.schema import Derivation, ObservationRequest, ObservationResponse
from service.models import registry
from service.models.loaded import LoadedModels, Served
from service.storage.database import Database, EventRow, ModelRow, StreamRow
from service.storage.disk import Disk

logger = logging.getLogger(__name__)

RETAIN_EVERY = 200
"""Batches of a model after which its log is brought within its limits."""
ROW_NUMBERS, NUMBER_BYTES = 6, 8
"""What a row takes of the disk, for each joint: motion and torque, and half as much again for times and indices."""
MOST_GAPS = 100
"""Gaps that an acknowledgement names."""
CONSEQUENCES = {
    "hold": "nothing is learnt until its owner has decided",
    "adapt": "a new regime begins, in which what was learnt before counts less",
    "learn": "learning goes on as before",
}


@dataclass(frozen=True)
class Arrival:
    """A batch that is new. last_sequence: of its last frame; offset (s), span: see `clock`; received: Unix time, s."""

    stream_id: str
    kind: StreamKind
    sequence: int
    last_sequence: int
    digest: str
    rows: int
    offset: float
    span: list[float] | None
    received: float


class Ingest:
    """Takes batches of observations; safe from several threads, not for the event loop.

    monitor: gives the monitor of a model that is served. wake: tells the learner that a model's log has grown.
    show: tells those who follow a model of a batch that is durable.
    """

    def __init__(
        self,
        settings: Settings,
        database: Database,
        loaded: LoadedModels,
        monitor: Callable[[Served], Monitor],
        wake: Callable[[str], None],
        disk: Disk,
        show: Callable[[Judged], None],
    ) -> None:
        self.settings, self.database, self.loaded, self.disk = settings, database, loaded, disk
        self._monitor, self._wake, self._show = monitor, wake, show

    def observe(self, model: str, request: ObservationRequest) -> ObservationResponse:
        """Take a batch; once this returns it is durable.

        Raise NotFoundError, LearningDisabledError, InvalidRequestError, ConflictError, ExpiredError, BusyError or
        StorageFullError.
        """
        served, received = self.loaded.get(model, None), time.time()
        came = measured(request, served.model, self.settings)
        content = identity.digest(came)
        monitor = self._monitor(served)
        with self.turn(monitor, model):
            answer = self._take(monitor, served, request, came, content, received)
        self.follow_up(monitor, model)
        return answer

    @contextmanager
    def turn(self, monitor: Monitor, model: str) -> Iterator[None]:
        """Be the only one, of all services, that takes something for a model; its monitor knows what others took.

        Raise StorageUnavailableError where the turn does not come within `database_timeout_s`.
        """
        # the turn first: who only looks at the monitor does not wait for other services
        with self.database.turn(model), monitor.lock:
            self._follow(monitor, model)
            yield

    def follow(self, monitor: Monitor, model: str) -> None:
        """Take in what other services took for a model."""
        if self.database.shared:
            with monitor.lock:
                self._follow(monitor, model)

    def _follow(self, monitor: Monitor, model: str) -> None:
        if self.database.shared:
            with self.database.session() as session:
                monitor.follow(session, model)

    def _take(
        self,
        monitor: Monitor,
        served: Served,
        request: ObservationRequest,
        came: Measured,
        content: str,
        received: float,
    ) -> ObservationResponse:
        model, stream_id, sequence = known_as = served.name, request.stream_id, request.sequence
        with self.database.session() as session:
            options, source = enabled(session, model), log.stream(session, model, stream_id)
            check_kind(source, "batches")
            answer = identity.known(session, *known_as, content)
            if answer is not None:
                monitor.counts["duplicates"] += 1
                return answer
            bounds = screening.limits(served.model, options, self.settings)
            before, after = log.neighbours(session, *known_as)
            clock = Clock.of(source, sequence, before, after, received)
            dated = screening.timed(came, clock, bounds, before.last if before is not None and clock.adjacent else None)
            rows, own, derived = dated.rows, slice(0, len(came)), None
            if came.ddq is None and came.t is not None:
                rows, own, derived = screening.derive(session, *known_as, rows, came.t, bounds)
        screened = screening.predict(rows, own, derived, served.model)
        arrival = Arrival(
            stream_id, "batches", sequence, sequence, content, len(came), dated.offset, dated.span, received
        )
        said = {"derived": None if derived is None else Derivation(ddq=derived).model_dump()}
        return ObservationResponse.model_validate(self.append(monitor, served, options, arrival, screened, said))

    def append(
        self,
        monitor: Monitor,
        served: Served,
        options: LearningOptions,
        arrival: Arrival,
        screened: Screened,
        said: dict[str, Any],
    ) -> dict[str, Any]:
        """Judge a batch and write it down with all that follows from it, in one transaction; the lock is held.

        Return the report that is kept of it: what is said of every batch, and `said`.
        """
        model = served.name
        self.disk.take(ROW_NUMBERS * NUMBER_BYTES * served.model.n_joints * arrival.rows)
        with self.database.transaction(model) as session:
            _check_kept(session, served)
            held = learning.held(session, model) is not None
            if monitor.held and not held:
                monitor.decided()
            usual = partial(monitor.usual, arrival.received)
            verdict = judging.judge(screened, monitor.watch(arrival.stream_id), held, options, usual)
            if verdict.change is not None and options.on_change == "adapt":
                log.append(session, model, "change", {"t": verdict.change.at}, arrival.received)
            batch = NewBatch(
                stream_id=arrival.stream_id,
                kind=arrival.kind,
                sequence=arrival.sequence,
                last_sequence=arrival.last_sequence,
                digest=arrival.digest,
                offset=arrival.offset,
                received=arrival.received,
                version=served.version,
                revision=served.revision,
                rows=verdict.rows,
                report={},
                record=None if verdict.record is None else verdict.record.to_json(),
            )
            event = log.append_batch(session, model, batch, self.settings.max_observation_streams)
            event.rows = arrival.rows  # those that had waited came with other batches
            source = log.stream(session, model, arrival.stream_id)
            assert source is not None
            if source.offset == 0:
                source.offset = arrival.offset
            if verdict.change is not None:
                _alarm(session, served, options, verdict, event)
            report = said | {
                "model": model,
                "version": served.version,
                "revision": event.number - log.start_of(session, model, served.version),
                "stream_id": arrival.stream_id,
                "sequence": arrival.sequence,
                "rows": arrival.rows,
                "accepted": event.learnt,
                "duplicate": False,
                "state": "learnt",
                "rejected": verdict.rows.rejected(),
                "gaps": [list(pair) for pair in source.missing["ranges"][-MOST_GAPS:]],
                "held": verdict.held,
                # for the batches that follow, for other services, and for one that starts again
                "own": [screened.own.start, screened.own.stop],
                "span": arrival.span,
                "open": verdict.watch.gate.open,
                "gate": verdict.watch.gate.to_json(),
                "waited": held,
                "until": screened.until,
                "surprise": None if verdict.surprise is None else verdict.surprise.tolist(),
            }
            event.report = report
        monitor.note(event, arrival.stream_id, verdict, report)
        self._show(Judged(served, arrival.stream_id, verdict.rows, screened))
        return report

    def follow_up(self, monitor: Monitor, model: str) -> None:
        """Do what follows once a batch is durable: it is learnt, and now and then the oldest go."""
        self._wake(model)
        if monitor.due(RETAIN_EVERY):
            try:
                retain(self.database, self.settings, model, time.time())
            except Exception as error:  # what came is logged all the same
                logger.error("the log of model %s was not brought within its limits", model, exc_info=error)


def enabled(session: Session, model: str) -> LearningOptions:
    """How a model learns; raise LearningDisabledError where it does not."""
    options = learning.options(session, model)
    if not options.enabled:
        raise LearningDisabledError(f"learning of model {model!r} is switched off: nothing is logged")
    return options


def check_kind(source: StreamRow | None, kind: StreamKind) -> None:
    """Raise ConflictError where a stream carries something else: one sequence cannot count both."""
    if source is not None and source.kind != kind:
        raise ConflictError(
            f"stream {source.stream_id!r} of model {source.model!r} carries {source.kind}, not {kind}: use another "
            "stream_id"
        )


def _check_kept(session: Session, served: Served) -> None:
    """Raise an error where a model, or the version that has predicted a batch, was deleted since the batch came."""
    if registry.exists(session, served.name, served.version):
        return
    if session.scalar(select(ModelRow.name).where(ModelRow.name == served.name)) is None:
        raise not_found("model", served.name)
    raise ConflictError(f"version {served.version} of model {served.name!r} was deleted meanwhile: send it again")


def _alarm(session: Session, served: Served, options: LearningOptions, verdict: Verdict, event: EventRow) -> None:
    """Tell the owner of a change, and wait for a decision where one is wanted."""
    change, names = verdict.change, served.model.joint_names
    assert change is not None
    evidence = verdict.evidence(names) | {"stream_id": event.stream_id, "sequence": event.sequence}
    joints = ", ".join(names[joint] for joint in change.joints)
    message = (
        f"the torque of {joints} does not fit what was learnt any more: {evidence['suspect']}? "
        f"{CONSEQUENCES[options.on_change]}"
    )
    alarms.raise_alarm(session, served.name, "change", message, evidence)
    if options.on_change == "hold":
        learning.hold(session, served.name, {"at": change.at, "event": event.number, "evidence": evidence})
