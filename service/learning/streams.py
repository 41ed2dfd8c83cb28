"""What is known of each stream of a model: one record a stream, in its row of the database.

A record lasts as long as its row: over restarts, other versions, rollbacks and the retention of the log. Services that
share a database read it again once another one has logged rows of the stream.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from lipcore.data.samples import Array
from lipcore.online.adaptive import Adaptive
from lipcore.online.changes.opening import Opening
from lipcore.online.judging import ContactGate
from service.learning.intervals import ScaleRecord
from service.models.scales import Factor
from service.storage.database import EventRow, LearningRow, StreamRow

FORMAT = 1
"""Of a record's JSON; a later release that changes it reads this one, too."""


@dataclass(frozen=True)
class PayloadRecord:
    """The latest known payload of a stream, declared or noticed.

    event: number of the event that declared or noticed it; received: Unix time of the latest rows that show it, s.
    watch: the estimate of `version`, see `Watch.to_json`; None for a declaration. body: the declared body, None for
    no payload.
    """

    event: int
    received: float
    watch: Mapping[str, Any] | None = None
    version: int | None = None
    body: Mapping[str, Any] | None = None

    @property
    def holds(self) -> bool:
        """Whether something is carried."""
        return self.body is not None or (self.watch is not None and self.watch["held"] is not None)

    def to_json(self) -> dict[str, Any]:
        """All fields as JSON has them; `PayloadRecord(**values)` reads them."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


@dataclass(frozen=True)
class StreamRecord:
    """What is known of a stream after its last batch; immutable.

    gate: which of its rows are contacts; opening: its first second, None once that is judged; doubted: whether that did
    not fit, and nobody has confirmed the stream since; scale: of its intervals, None where they do not adapt; payload:
    what it carries, None where nothing was said or noticed; leapt: whether its clock has leapt ahead of its rows'
    arrival; begun: number of its first batch's event; received: when the last batch came, Unix time, s.
    """

    gate: ContactGate
    opening: Opening | None = None
    doubted: bool = False
    scale: ScaleRecord | None = None
    payload: PayloadRecord | None = None
    leapt: bool = False
    begun: int = 0
    received: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """As the stream's row has it."""
        return {
            "format": FORMAT,
            "gate": self.gate.to_json(),
            "opening": None if self.opening is None else self.opening.to_json(),
            "doubted": self.doubted,
            "scale": None if self.scale is None else self.scale.to_json(),
            "payload": None if self.payload is None else self.payload.to_json(),
            "leapt": self.leapt,
            "begun": self.begun,
        }

    def decided(self) -> StreamRecord:
        """The same after learning was held: what has changed is no contact."""
        return replace(self, gate=self.gate.stand_back())

    @classmethod
    def of(cls, row: StreamRow, patience_s: float) -> StreamRecord:
        """Read what a row has. patience_s: how long contacts are kept out, as it is set now."""
        values, received = row.record, row.received or 0.0
        if values is None:  # written by a service of an earlier release
            return cls(ContactGate.start(patience_s), received=received)
        opening, scale, payload = (values[name] for name in ("opening", "scale", "payload"))
        return cls(
            ContactGate.from_json(values["gate"], patience_s),
            None if opening is None else Opening.from_json(opening),
            values["doubted"],
            None if scale is None else ScaleRecord.from_json(scale),
            None if payload is None else PayloadRecord(**payload),
            values["leapt"],
            values["begun"],
            received,
        )


class Streams:
    """The records of one model's streams; for any thread. A record is written by whoever has the model's turn.

    patience_s: how long contacts are kept out, for those who judge rows; default: what was declared for all streams,
    None where nothing was.
    """

    def __init__(self, patience_s: float = 0.0) -> None:
        self._patience_s, self._lock = patience_s, threading.Lock()
        self._records: Mapping[str, StreamRecord] = {}
        self.default: PayloadRecord | None = None

    @classmethod
    def restored(cls, session: Session, model: str) -> Streams:
        """Those that the database has, for those who judge no rows."""
        made = cls()
        made.read(session, model)
        return made

    def read(self, session: Session, model: str, stream_ids: Collection[str] | None = None) -> None:
        """Read what other services have written: of these streams, of all where None."""
        query = select(StreamRow).where(StreamRow.model == model).options(undefer(StreamRow.record))
        if stream_ids is not None:
            query = query.where(StreamRow.stream_id.in_(stream_ids))
        rows = {row.stream_id: StreamRecord.of(row, self._patience_s) for row in session.scalars(query)}
        declared = session.scalar(select(LearningRow.payload).where(LearningRow.model == model))
        with self._lock:
            self._records = rows if stream_ids is None else {**self._records, **rows}
            self.default = None if declared is None else PayloadRecord(**declared)

    def all(self) -> Mapping[str, StreamRecord]:
        """Every record, by stream."""
        return self._records

    def get(self, stream_id: str) -> StreamRecord:
        """The record of a stream, that of a new one where none is known."""
        return self._records.get(stream_id) or StreamRecord(ContactGate.start(self._patience_s))

    def payload(self, stream_id: str) -> PayloadRecord | None:
        """Return the newest payload record of a stream, its own or that of all streams; of "" that of all streams."""
        own = self.get(stream_id).payload
        if own is None or (self.default is not None and self.default.event > own.event):
            return self.default
        return own

    def factors(self, version: int) -> dict[str, Factor]:
        """The factors on the widths of a version's intervals, of streams whose last batch it predicted."""
        return {
            name: Factor(record.scale.state.factor, record.scale.accepted.factor, record.received, record.doubted)
            for name, record in self._records.items()
            if record.scale is not None and record.scale.version == version
        }

    def change(self, stream_id: str, **fields: Any) -> StreamRecord:
        """Replace fields of a record, and return it."""
        with self._lock:
            record = replace(self.get(stream_id), **fields)
            self._records = {**self._records, stream_id: record}
        return record

    def take_back(self, session: Session, model: str, version: int, own: Array) -> None:
        """Answer others with the scales that streams had after the last of their batches that still counts, of a
        version with an `own` scale, (n,). Batches of earlier releases do not say it."""
        counts = (EventRow.model == model, EventRow.version == version, EventRow.void.is_(False))
        for stream_id, record in self._records.items():
            if record.scale is None or record.scale.version != version:
                continue
            of_stream = select(EventRow.report).where(
                *counts, EventRow.stream_id == stream_id, EventRow.kind == "batch"
            )
            report = session.scalar(of_stream.order_by(EventRow.number.desc()).limit(1))
            accepted = Adaptive.start(own) if report is None else record.scale.accepted
            if report is not None and "accepted_scale" in report:
                accepted = Adaptive.from_json(report["accepted_scale"])
            self.change(stream_id, scale=replace(record.scale, accepted=accepted))
        self.change_all(session, model, lambda record: record)

    def set_clock(self, step: float) -> None:
        """Go with a clock of this machine that was set by `step`, s, as the database does."""
        with self._lock:
            moved = {name: replace(record, received=record.received + step) for name, record in self._records.items()}
            self._records = moved

    def change_all(self, session: Session, model: str, act: Callable[[StreamRecord], StreamRecord]) -> None:
        """Change all records, also in the database."""
        with self._lock:
            self._records = {name: act(record) for name, record in self._records.items()}
        for row in session.scalars(select(StreamRow).where(StreamRow.model == model)):
            row.record = self.get(row.stream_id).to_json()

    def forget(self, stream_id: str) -> None:
        """Forget a stream."""
        with self._lock:
            self._records = {name: record for name, record in self._records.items() if name != stream_id}

    def expire(self, session: Session, model: str, silent_since: float) -> None:
        """Delete the streams of a model whose last batch came before a Unix time, s, and that carry nothing, which
        would be lost with them."""
        silent = StreamRow.model == model, StreamRow.received < silent_since
        for row in session.scalars(select(StreamRow).where(*silent).options(undefer(StreamRow.record))):
            payload = StreamRecord.of(row, self._patience_s).payload
            if payload is None or not payload.holds:
                session.delete(row)
        session.flush()
        self.keep(session, model)

    def keep(self, session: Session, model: str) -> None:
        """Forget the streams that the database no longer has."""
        known = set(session.scalars(select(StreamRow.stream_id).where(StreamRow.model == model)))
        with self._lock:
            self._records = {name: record for name, record in self._records.items() if name in known}
