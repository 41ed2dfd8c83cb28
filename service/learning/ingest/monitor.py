"""The memory of a running service about a model that learns. All of it can be rebuilt from the log."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from lipcore.online.judgement import Innovations, LoggedJudgement, ModelRecord
from lipcore.online.judging import Judgement
from lipcore.online.record import Record
from lipcore.online.stream import StreamRecord
from lipcore.online.window import Window
from service.journal import log
from service.learning import owner
from service.learning.payloads import Payloads
from service.learning.streams import Streams
from service.storage.database import EventRow

WINDOWS_S = (60.0, 600.0, 3600.0)
"""Lengths of the windows of prediction quality, s."""
MAX_EVENTS = 3000
"""Max events from which the windows are rebuilt after a start: 0.3 ms each."""
DETECTOR_S = 60.0
"""Seconds before a start from which the change detector is rebuilt: more than its memory."""


class Monitor:
    """One model's quality windows, and the records of the model and its streams.

    joint_names: their order in records. record: of the model. streams: the records of its streams. payloads: of the
    streams, as versions see them. payload_alarm_at: Unix time of the last payload alarm, s. lock: locked while a batch
    is judged and logged; readers do not need it. counts: rows by code and "learnt", "batches" and "duplicates",
    ingested by this service since its start. number: of the last event that the monitor contains.

    If several services ingest batches of one model, each follows the log before it judges. Their records and windows
    are then equal, to the last bit, to those of a single service.
    """

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        self.joint_names, self.lock = joint_names, threading.Lock()
        n = len(joint_names)
        self.windows = tuple(Window(seconds, n) for seconds in WINDOWS_S)
        self.counts: Counter[str] = Counter()
        self.number, self._since_due = 0, 0
        self.record = ModelRecord(Innovations.empty(n))
        self.streams = Streams()
        self.payloads = Payloads(self.streams)
        self.payload_alarm_at = -np.inf

    @classmethod
    def rebuilt(cls, session: Session, model: str, joint_names: tuple[str, ...], now: float) -> Monitor:
        """Return the monitor of a model from its log and its streams' records. now: Unix time, s."""
        made = cls(joint_names)
        made.number = log.newest(session, model)
        made.streams.read(session, model)
        made.payloads = Payloads.restored(session, model, made.streams)
        since = now - max(*WINDOWS_S, DETECTOR_S)
        lately = (EventRow.received > since, EventRow.received <= now, EventRow.number <= made.number)
        events = list(_batches(session, model, *lately)) or list(_batches(session, model, most=1))
        for event in events:  # at least the last one, so that a quiet hour does not reset the record
            made._add_logged(event, now - DETECTOR_S < event.received <= now)
        return made

    def follow(self, session: Session, model: str) -> bool:
        """Add events that other services have logged since `number`; return whether there were any.

        `lock` is locked.
        """
        newest = log.newest(session, model)
        if newest == self.number:
            return False
        later = EventRow.number > self.number, EventRow.number <= newest
        kinds = EventRow.kind.in_(("payload", "rollback"))
        others = session.execute(
            select(EventRow.stream_id, EventRow.kind).where(EventRow.model == model, kinds, *later)
        )
        said = [(stream_id or "", kind) for stream_id, kind in others]
        streams, decided = {stream_id for stream_id, _ in said}, any(kind == "rollback" for _, kind in said)
        for event in _batches(session, model, *later):
            held = self.record.held
            logged = self._add_logged(event, True)
            decided |= held and logged is not None and not logged.waited
            streams.add(event.stream_id or "")
        if streams:  # a decision or a rollback changes the records of all streams
            self.streams.read(session, model, None if decided else streams)
        self.number = newest
        return True

    def follow_decision(self, session: Session, model: str) -> None:
        """Judge streams anew if the owner has ended a pause; `lock` is locked."""
        held = owner.read_pause(session, model) is not None
        if self.record.held and not held:
            self.record = self.record.decided()
            self.streams.change_all(session, model, StreamRecord.decided)
        elif held and not self.record.held:
            self.record = replace(self.record, held=True)

    def stream(self, stream_id: str, new: bool) -> StreamRecord:
        """Return the record of a stream before its next batch; `lock` is locked.

        new: whether the stream has no batch yet.
        """
        if not new:
            return self.streams.get(stream_id)
        self.streams.forget(stream_id)  # an earlier stream of this name was deleted
        return StreamRecord.start(len(self.joint_names))

    def read_latest_record(self, now: float) -> Record:
        """Return the record of the shortest window before a Unix time, s."""
        return min(self.windows, key=lambda window: window.seconds).record(now)

    def add_batch(self, event: EventRow, judgement: Judgement) -> None:
        """Add a batch that this service has judged and logged; `lock` is locked."""
        counts = _counts(event.report or {})
        self._count(event, judgement.record, counts, judgement.logged)
        self.number, self.record = event.number, judgement.model
        self.counts.update({"batches": 1, **counts})
        self._since_due += 1

    def due(self, batches: int) -> bool:
        """Return whether so many batches have been added since this last returned True."""
        with self.lock:
            if self._since_due < batches:
                return False
            self._since_due = 0
            return True

    def set_clock(self, step: float) -> None:
        """Move all times by `step`, s, after the host's clock was set; `lock` is locked."""
        for window in self.windows:
            window.set_clock(step)
        self.streams.set_clock(step)
        self.record = self.record.moved(step)

    def _add_logged(self, event: EventRow, recent: bool) -> LoggedJudgement | None:
        """Add a batch with its logged judgement; return the judgement, None if the batch has other joints.

        recent: whether the batch is within the detector's memory.
        """
        record = None if event.record is None else Record.from_json(event.record)
        if record is not None and record.n_joints != len(self.joint_names):
            return None
        report = event.report or {}
        logged = LoggedJudgement.from_json(report)
        self._count(event, record, _counts(report), logged)
        self.record = self.record.follow(logged, record, recent)
        return logged

    def _count(
        self, event: EventRow, record: Record | None, counts: Mapping[str, int], logged: LoggedJudgement
    ) -> None:
        for window in self.windows:
            window.add(record, counts, event.received, logged.answered)


def _batches(
    session: Session, model: str, *conditions: ColumnElement[bool], most: int = MAX_EVENTS
) -> Iterator[EventRow]:
    """Return the last batches of a model that meet conditions, at most `most`, in order."""
    query = select(EventRow).where(
        EventRow.model == model, EventRow.kind == "batch", EventRow.report.is_not(None), *conditions
    )
    return reversed(list(session.scalars(query.order_by(EventRow.number.desc()).limit(most))))


def _counts(report: Mapping[str, Any]) -> dict[str, int]:
    """Return the number of rows by code, including those learnt."""
    return {"learnt": report["accepted"], **report["rejected"]}
