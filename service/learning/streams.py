"""The records of a model's streams, one for each stream, in its row of the database.

A record lasts as long as its row: over restarts, version changes, rollbacks and retention. A service reads a record
again after another service has logged rows of the stream.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from lipcore.data.samples import Array
from lipcore.online.adaptive import AdaptiveScale
from lipcore.online.judgement import LoggedJudgement
from lipcore.online.stream import PayloadRecord, StreamRecord
from service.models.scales import Factor
from service.storage.database import EventRow, LearningRow, StreamRow


class Streams:
    """The stream records of one model, safe from several threads. Only a thread that has the model's turn writes.

    default: the payload declared for all streams, None if none was.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._records: Mapping[str, StreamRecord] = {}
        self.default: PayloadRecord | None = None

    @classmethod
    def restored(cls, session: Session, model: str) -> Streams:
        """Return the stored records, for a process that judges no rows."""
        made = cls()
        made.read(session, model)
        return made

    def read(self, session: Session, model: str, stream_ids: Collection[str] | None = None) -> None:
        """Read the records that other services have written, of these streams or, if None, of all."""
        query = select(StreamRow).where(StreamRow.model == model).options(undefer(StreamRow.record))
        if stream_ids is not None:
            query = query.where(StreamRow.stream_id.in_(stream_ids))
        rows = {row.stream_id: _record_of(row) for row in session.scalars(query)}
        declared = session.scalar(select(LearningRow.payload).where(LearningRow.model == model))
        with self._lock:
            self._records = rows if stream_ids is None else {**self._records, **rows}
            self.default = None if declared is None else PayloadRecord(**declared)

    def all(self) -> Mapping[str, StreamRecord]:
        """Return every record by stream."""
        return self._records

    def get(self, stream_id: str) -> StreamRecord:
        """Return the record of a stream; a new record if the stream is unknown."""
        return self._records.get(stream_id) or StreamRecord()

    def payload(self, stream_id: str) -> PayloadRecord | None:
        """Return the newest payload record of a stream: its own or the default; for "" the default."""
        own = self.get(stream_id).payload
        if own is None or (self.default is not None and self.default.event > own.event):
            return self.default
        return own

    def factors(self, version: int) -> dict[str, Factor]:
        """Return the interval factors of a version, for the streams of which it predicted the last batch."""
        return {
            name: Factor(record.scale.state.factor, record.scale.accepted.factor, record.received, record.doubted)
            for name, record in self._records.items()
            if record.scale is not None and record.scale.version == version
        }

    def change(self, stream_id: str, **fields: Any) -> StreamRecord:
        """Replace fields of a record and return the new record."""
        with self._lock:
            record = replace(self.get(stream_id), **fields)
            self._records = {**self._records, stream_id: record}
        return record

    def store_judged(self, stream_id: str, record: StreamRecord) -> None:
        """Store the record of a stream after a batch. Its payload stays: it may have changed meanwhile."""
        with self._lock:
            payload = self.get(stream_id).payload
            self._records = {**self._records, stream_id: replace(record, payload=payload)}

    def restore_scales(self, session: Session, model: str, version: int, own: Array) -> None:
        """Set the accepted scale of each stream to that of its last batch that is not void.

        own: scale of the version as trained, (n,), for a stream without such a batch. Batches of earlier releases have
        no scale.
        """
        counts = (EventRow.model == model, EventRow.version == version, EventRow.void.is_(False))
        for stream_id, record in self._records.items():
            if record.scale is None or record.scale.version != version:
                continue
            of_stream = select(EventRow.report).where(
                *counts, EventRow.stream_id == stream_id, EventRow.kind == "batch"
            )
            report = session.scalar(of_stream.order_by(EventRow.number.desc()).limit(1))
            logged = None if report is None else LoggedJudgement.from_json(report).accepted_scale
            accepted = AdaptiveScale.start(own) if report is None else logged or record.scale.accepted
            self.change(stream_id, scale=replace(record.scale, accepted=accepted))
        self.change_all(session, model, lambda record: record)

    def set_clock(self, step: float) -> None:
        """Move all times by `step`, s, after the host's clock was set."""
        with self._lock:
            moved = {name: replace(record, received=record.received + step) for name, record in self._records.items()}
            self._records = moved

    def change_all(self, session: Session, model: str, act: Callable[[StreamRecord], StreamRecord]) -> None:
        """Change all records, in memory and in the database."""
        with self._lock:
            self._records = {name: act(record) for name, record in self._records.items()}
        for row in session.scalars(select(StreamRow).where(StreamRow.model == model)):
            row.record = self.get(row.stream_id).to_json()

    def forget(self, stream_id: str) -> None:
        """Delete the record of a stream from memory."""
        with self._lock:
            self._records = {name: record for name, record in self._records.items() if name != stream_id}

    def expire(self, session: Session, model: str, silent_since: float) -> None:
        """Delete the streams of a model with a last batch before a Unix time, s. Streams with a payload stay."""
        silent = StreamRow.model == model, StreamRow.received < silent_since
        for row in session.scalars(select(StreamRow).where(*silent).options(undefer(StreamRow.record))):
            payload = _record_of(row).payload
            if payload is None or not payload.has_payload:
                session.delete(row)
        session.flush()
        self.drop_deleted(session, model)

    def drop_deleted(self, session: Session, model: str) -> None:
        """Delete the records of streams that the database no longer has."""
        known = set(session.scalars(select(StreamRow.stream_id).where(StreamRow.model == model)))
        with self._lock:
            self._records = {name: record for name, record in self._records.items() if name in known}


def _record_of(row: StreamRow) -> StreamRecord:
    return StreamRecord.from_json(row.record, row.received or 0.0)
