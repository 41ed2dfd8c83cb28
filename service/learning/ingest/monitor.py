"""What a running service keeps in memory of a model that learns; all of it can be rebuilt from the log."""

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
"""Windows of the prequential quality, s."""
MOST_EVENTS = 3000
"""Events that the windows are rebuilt from after a start, at most: 0.3 ms each."""
DETECTOR_S = 60.0
"""Time before a start that the detector of changes is rebuilt from, s: more than it looks back."""


class Monitor:
    """One model's windows of quality, and what judging knows of it and of its streams.

    joint_names: in whose order records are. record: of the model; streams: of each stream; payloads: what they carry,
    as versions see it; payload_alarm_at: when an alarm was last raised of one, Unix time, s. lock: held while a batch
    is judged and logged, one at a time; whoever only reads needs none. counts: rows by code and "learnt", "batches" and
    "duplicates", since the start and that this service has taken. number: of the last event that was taken in.

    Several services take batches of one model in turn, and each follows the log before it judges: records and windows
    are then the same to the last bit as if one service had taken all, from the first batch on that all of them know.
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
        """The monitor of a model from its log and its streams' records. now: Unix time, s."""
        made = cls(joint_names)
        made.number = log.newest(session, model)
        made.streams.read(session, model)
        made.payloads = Payloads.restored(session, model, made.streams)
        since = now - max(*WINDOWS_S, DETECTOR_S)
        lately = (EventRow.received > since, EventRow.received <= now, EventRow.number <= made.number)
        events = list(_batches(session, model, *lately)) or list(_batches(session, model, most=1))
        for event in events:  # the last one in any case: how far learning has gone is not forgotten in a quiet hour
            made._remember(event, now - DETECTOR_S < event.received <= now)
        return made

    def follow(self, session: Session, model: str) -> bool:
        """Take in what others have logged since `number`, and return whether that is anything; `lock` is held."""
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
            logged = self._remember(event, True)
            decided |= held and logged is not None and not logged.waited
            streams.add(event.stream_id or "")
        if streams:  # a decision, and a rollback, is in the records of all
            self.streams.read(session, model, None if decided else streams)
        self.number = newest
        return True

    def follow_decision(self, session: Session, model: str) -> None:
        """Judge streams anew if the owner has ended a hold; `lock` is held."""
        held = owner.held(session, model) is not None
        if self.record.held and not held:
            self.record = self.record.decided()
            self.streams.change_all(session, model, StreamRecord.decided)
        elif held and not self.record.held:
            self.record = replace(self.record, held=True)

    def stream(self, stream_id: str, new: bool) -> StreamRecord:
        """The record of a stream before its next batch; `lock` is held. new: whether none of its rows is known."""
        if not new:
            return self.streams.get(stream_id)
        self.streams.forget(stream_id)  # one of this name that has made room for others
        return StreamRecord.start(len(self.joint_names))

    def usual(self, now: float) -> Record:
        """Record of the shortest window before a Unix time, s."""
        return min(self.windows, key=lambda window: window.seconds).record(now)

    def note(self, event: EventRow, judgement: Judgement) -> None:
        """Take in a batch that this service has judged and logged; `lock` is held."""
        counts = _counts(event.report or {})
        self._count(event, judgement.record, counts, judgement.logged)
        self.number, self.record = event.number, judgement.model
        self.counts.update({"batches": 1, **counts})
        self._since_due += 1

    def due(self, batches: int) -> bool:
        """Whether so many batches have been noted since the last time that this was true."""
        with self.lock:
            if self._since_due < batches:
                return False
            self._since_due = 0
            return True

    def set_clock(self, step: float) -> None:
        """Go with a clock of this machine that was set by `step`, s; `lock` is held."""
        for window in self.windows:
            window.set_clock(step)
        self.streams.set_clock(step)
        self.record = self.record.moved(step)

    def _remember(self, event: EventRow, recent: bool) -> LoggedJudgement | None:
        """Take in a batch as it was judged when it was logged; None if it has other joints. recent: whether the
        detector still looks back to it."""
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
    session: Session, model: str, *conditions: ColumnElement[bool], most: int = MOST_EVENTS
) -> Iterator[EventRow]:
    """The last batches of a model that meet conditions, as many as are taken in, in order."""
    query = select(EventRow).where(
        EventRow.model == model, EventRow.kind == "batch", EventRow.report.is_not(None), *conditions
    )
    return reversed(list(session.scalars(query.order_by(EventRow.number.desc()).limit(most))))


def _counts(report: Mapping[str, Any]) -> dict[str, int]:
    """Rows by code, those that are learnt too."""
    return {"learnt": report["accepted"], **report["rejected"]}
