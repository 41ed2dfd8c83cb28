"""What a running service keeps in memory of a model that learns; all of it can be told again from the log."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.online.change import ChangeDetector
from lipcore.online.record import Record
from lipcore.vocabulary import CODES, LEARNT
from service.database import EventRow
from service.settings import Settings
from service.updates.ingest.contacts import ContactGate
from service.updates.ingest.judging import Innovations, Verdict, Watch
from service.updates.quality.windows import Window

MOST_EVENTS = 3000
"""Events that the windows are rebuilt from after a start, at most: 0.3 ms each."""
DETECTOR_S = 60.0
"""Time before a start that the detector of changes is rebuilt from, s: more than it looks back."""


class Monitor:
    """One model's windows of quality, its gates and its detector of changes.

    joint_names: in whose order records are. lock: held while a batch is judged and logged, one at a time; whoever only
    reads windows and counts needs none. counts: rows by code and "learnt", "batches" and "duplicates", since the start.
    held: whether learning waited for a decision at the last batch.
    """

    def __init__(self, joint_names: tuple[str, ...], settings: Settings) -> None:
        self.joint_names, self.lock = joint_names, threading.Lock()
        n = len(joint_names)
        self.windows = tuple(Window(seconds, n) for seconds in settings.quality_windows_s)
        self.counts: Counter[str] = Counter()
        self.held = False
        self._since_due = 0
        self._patience, self._most_streams = settings.contact_patience_s, settings.max_observation_streams
        self._gates: OrderedDict[str, ContactGate] = OrderedDict()
        self._detector, self._innovations = ChangeDetector(), Innovations.empty(n)

    @classmethod
    def rebuilt(
        cls, session: Session, model: str, joint_names: tuple[str, ...], settings: Settings, now: float
    ) -> Monitor:
        """The monitor of a model from its log. now: Unix time, s."""
        made = cls(joint_names, settings)
        since = now - max(*settings.quality_windows_s, DETECTOR_S)
        query = select(EventRow).where(
            EventRow.model == model, EventRow.kind == "batch", EventRow.received > since, EventRow.report.is_not(None)
        )
        for event in reversed(list(session.scalars(query.order_by(EventRow.number.desc()).limit(MOST_EVENTS)))):
            made._remember(event, event.received > now - DETECTOR_S)
        return made

    def watch(self, stream_id: str) -> Watch:
        """What is known before the next rows of a stream."""
        gate = self._gates.get(stream_id) or ContactGate.start(self._patience)
        return Watch(gate, self._detector, self._innovations)

    def usual(self, now: float) -> Record:
        """Record of the shortest window before a Unix time, s."""
        return min(self.windows, key=lambda window: window.seconds).record(now)

    def note(self, stream_id: str, verdict: Verdict, report: Mapping[str, Any], received: float) -> None:
        """Take in a batch that has been logged with this report; `lock` is held."""
        counts = _counts(report)
        self._add(verdict.record, counts, received)
        self.counts.update({"batches": 1, **counts})
        self._since_due += 1
        self._detector, self._innovations = verdict.watch.detector, verdict.watch.innovations
        self.held = verdict.held
        self._keep(stream_id, verdict.watch.gate)

    def due(self, batches: int) -> bool:
        """Whether so many batches have been noted since the last time that this was true."""
        with self.lock:
            if self._since_due < batches:
                return False
            self._since_due = 0
            return True

    def decided(self) -> None:
        """Learning goes on after it was held; `lock` is held. What has changed is no contact."""
        self.held = False
        self._gates.update({stream_id: gate.stand_back() for stream_id, gate in self._gates.items()})

    def _remember(self, event: EventRow, recent: bool) -> None:
        report = event.report or {}
        record = None if event.record is None else Record.from_json(event.record)
        if record is not None and record.n_joints != len(self.joint_names):
            return
        self._add(record, _counts(report), event.received)
        self.held = report["held"]
        if event.stream_id is not None:
            gate = ContactGate.start(self._patience)
            self._keep(event.stream_id, gate.stand_back() if report["open"] or report["held"] else gate)
        if record is not None and recent and event.last is not None:
            told = replace(record, standardised=np.array(report["surprise"]))
            self._detector, _ = self._detector.step(told, event.last)
            if not (report["open"] or report["held"]):
                self._detector = self._detector.acknowledged()

    def _add(self, record: Record | None, counts: Mapping[str, int], received: float) -> None:
        for window in self.windows:
            window.add(record, counts, received)

    def _keep(self, stream_id: str, gate: ContactGate) -> None:
        self._gates[stream_id] = gate
        self._gates.move_to_end(stream_id)
        if len(self._gates) > self._most_streams:
            self._gates.popitem(last=False)


def _counts(report: Mapping[str, Any]) -> dict[str, int]:
    """Rows by code, those that are learnt too."""
    return {CODES[LEARNT]: report["accepted"], **report["rejected"]}
