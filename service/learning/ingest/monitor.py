"""What a running service keeps in memory of a model that learns; all of it can be rebuilt from the log."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from lipcore.data.samples import Array
from lipcore.online.changes.departure import Departure
from lipcore.online.changes.detectors import ChangeDetector
from lipcore.online.changes.opening import Opening
from lipcore.online.judging import Innovations, Watch
from lipcore.online.record import Record
from lipcore.vocabulary import CODES, LEARNT
from service.journal import log
from service.learning import intervals
from service.learning.intervals import HeldIntervals, ScaleRecord
from service.learning.payloads import Payloads
from service.learning.streams import Streams
from service.storage.database import EventRow

WINDOWS_S = (60.0, 600.0, 3600.0)
"""Windows of the prequential quality, s."""
CONTACT_PATIENCE_S = 2.0
"""How long torques may be far off before it is no contact but a change of the robot, s."""
PARTS = 60
"""Buckets of a window: its length is true to a sixtieth."""
MOST_EVENTS = 3000
"""Events that the windows are rebuilt from after a start, at most: 0.3 ms each."""
DETECTOR_S = 60.0
"""Time before a start that the detector of changes is rebuilt from, s: more than it looks back."""


class Window:
    """Records and counts of the last `seconds`, in at most PARTS + 1 buckets. Read it from any thread."""

    def __init__(self, seconds: float, n_joints: int) -> None:
        self.seconds, self._n_joints = seconds, n_joints
        self._length = max(seconds / PARTS, 1.0)
        self._buckets: tuple[tuple[int, Record, Counter[str], HeldIntervals], ...] = ()

    def add(
        self, record: Record | None, counts: Mapping[str, int], at: float, held: HeldIntervals | None = None
    ) -> None:
        """Add a batch's record and counts at a Unix time, s, and what intervals held. From one thread at a time."""
        number = int(at // self._length)
        empty = number, Record.empty(self._n_joints), Counter[str](), HeldIntervals.none(self._n_joints)
        *rest, last = self._buckets or (empty,)
        if last[0] != number:
            rest, last = [*rest, last], empty
        changed = (
            number,
            last[1] if record is None else last[1] + record,
            last[2] + Counter(counts),
            last[3] if held is None else last[3] + held,
        )
        # another tuple each time: readers keep the one they have
        self._buckets = tuple(bucket for bucket in (*rest, changed) if self._holds(bucket[0], at))

    def record(self, now: float) -> Record:
        """Sum of the records within the window before a Unix time, s."""
        records = (bucket[1] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, records, Record.empty(self._n_joints))

    def course(self, now: float) -> list[tuple[float, Record]]:
        """The records of the window's buckets, oldest first, each with when it began: Unix times, s."""
        return [(number * self._length, record) for number, record, *_ in self._buckets if self._holds(number, now)]

    def counts(self, now: float) -> Counter[str]:
        """Sum of the counts within the window before a Unix time, s."""
        counts = (bucket[2] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, counts, Counter[str]())

    def held(self, now: float) -> HeldIntervals:
        """What intervals, as answered, held of the rows within the window before a Unix time, s."""
        parts = (bucket[3] for bucket in self._buckets if self._holds(bucket[0], now))
        return reduce(add, parts, HeldIntervals.none(self._n_joints))

    def set_clock(self, step: float) -> None:
        """Take the buckets with a clock that was set by `step`, s."""
        moved = round(step / self._length)
        self._buckets = tuple((bucket[0] + moved, *bucket[1:]) for bucket in self._buckets)

    def _holds(self, number: int, now: float) -> bool:
        """Whether a bucket is in the window before a Unix time, s; none is that a wrong clock has put behind it."""
        return -self.seconds < (number + 1) * self._length - now <= 2 * self._length


class Monitor:
    """One model's windows of quality, the records of its streams, and its detector of changes.

    joint_names: in whose order records are. streams: what is known of each; payloads: what they carry, as versions see
    it; payload_alarm_at: when an alarm was last raised of one, Unix time, s. lock: held while a batch is judged and
    logged, one at a time; whoever only reads needs none. counts: rows by code and "learnt", "batches" and "duplicates",
    since the start and that this service has taken. held: whether learning waited for a decision at the last batch.
    number: of the last event that was taken in.

    Several services take batches of one model in turn, and each follows the log before it judges: streams, detector and
    windows are then the same to the last bit as if one service had taken all, from the first batch on that all of them
    know. Innovations are those of this service's own batches, because the log has no predictions: friction is told from
    a payload on fewer rows then.
    """

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        self.joint_names, self.lock = joint_names, threading.Lock()
        n = len(joint_names)
        self.windows = tuple(Window(seconds, n) for seconds in WINDOWS_S)
        self.counts: Counter[str] = Counter()
        self.held, self.number = False, 0
        self._since_due = 0
        self._detector, self._innovations = ChangeDetector(), Innovations.empty(n)
        self._departure: Departure | None = None
        self.streams = Streams(CONTACT_PATIENCE_S)
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

    def follow(self, session: Session, model: str) -> None:
        """Take in what other services have logged since `number`; `lock` is held."""
        decided, streams = False, set[str]()
        since = EventRow.model == model, EventRow.kind.in_(("payload", "rollback")), EventRow.number > self.number
        others = session.execute(select(EventRow.stream_id, EventRow.number, EventRow.kind).where(*since)).all()
        for event in _batches(session, model, EventRow.number > self.number):
            held = self.held
            self._remember(event, True)
            decided |= held and not (event.report or {})["waited"]
            self.number = event.number
            streams.add(event.stream_id or "")
        for stream_id, number, kind in others:
            self.number = max(self.number, number)
            streams.add(stream_id or "")
            decided |= kind == "rollback"
        if streams:  # a decision, and a rollback, is in the records of all
            self.streams.read(session, model, None if decided else streams)

    def watch(self, stream_id: str, new: bool = False) -> Watch:
        """State of judging before the next rows of a stream. new: whether none of its rows is known."""
        known = self.streams.get(stream_id)
        opening = Opening.start(len(self.joint_names)) if new else known.opening
        return Watch(known.gate, self._detector, self._innovations, self._departure, opening)

    def scale(self, stream_id: str, version: int, own: Array) -> ScaleRecord:
        """The scale of a stream's intervals before its next rows, which a version predicts: another one begins anew,
        from its `own`, (n,)."""
        known = self.streams.get(stream_id).scale
        return ScaleRecord.start(own, version) if known is None or known.version != version else known

    def usual(self, now: float) -> Record:
        """Record of the shortest window before a Unix time, s."""
        return min(self.windows, key=lambda window: window.seconds).record(now)

    def note(self, event: EventRow, innovations: Innovations) -> None:
        """Take in a batch that this service has logged; `lock` is held. innovations: those up to it."""
        self._remember(event, True)
        self.number, self._innovations = event.number, innovations
        self.counts.update({"batches": 1, **_counts(event.report or {})})
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
        self._detector = self._detector.moved(step)

    def decided(self) -> None:
        """Learning goes on after it was held; `lock` is held."""
        self.held = False
        self._departure = self._departure and self._departure.decided()

    def _remember(self, event: EventRow, recent: bool) -> None:
        """Take in a batch as it was judged when it was logged. recent: whether the detector still looks back to it."""
        report = event.report or {}
        record = None if event.record is None else Record.from_json(event.record)
        if record is not None and record.n_joints != len(self.joint_names):
            return
        held = intervals.held(report)
        for window in self.windows:
            window.add(record, _counts(report), event.received, held)
        if self.held and not report["waited"]:
            self.decided()
        self.held, waits = report["held"], report["held"] or report["open"]
        departure = report["departure"]
        self._departure = None if departure is None else Departure.from_json(departure)
        at = report["until"]
        if at is None or not recent:
            return
        if record is not None:
            judged = replace(record, standardised=np.array(report["surprise"], np.float64))
            self._detector, _ = self._detector.step(judged, at)
        if not waits:
            self._detector = self._detector.acknowledged()


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
    return {CODES[LEARNT]: report["accepted"], **report["rejected"]}
