"""The arrival of batches: gaps in a stream, batches that may be repeated, room for new streams.

Functions that write are called inside `Database.transaction()`, like those of the log.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from sqlalchemy import case, func, select
from sqlalchemy.orm import Session

from lipcore.online.batch import Rows
from service.foundation.errors import BusyError, ConflictError
from service.storage.database import EventRow, StreamRow, now

StreamKind = Literal["batches", "frames"]
MAX_RANGES = 1000
"""Max stored gaps of a stream. The lowest are dropped first, as they are the least likely to be filled."""
MIN_SILENT_S = 10.0
"""Seconds without a batch after which a stream may be deleted to make room for a new one."""


@dataclass(frozen=True)
class NewBatch:
    """A batch to be logged. Its fields are those of `EventRow` and, for a new stream, of `StreamRow`."""

    stream_id: str
    kind: StreamKind
    sequence: int
    last_sequence: int
    digest: str
    offset: float
    received: float
    version: int
    revision: int
    rows: Rows
    report: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] | None = None


@dataclass(frozen=True)
class Gaps:
    """The sequences of a stream that are missing."""

    first: int
    """Lowest sequence that has arrived."""
    last: int
    """Highest sequence that has arrived."""
    ranges: tuple[tuple[int, int], ...] = ()
    """Missing ranges [a, b] between `first` and `last`, in rising order."""

    def arrived(self, first: int, last: int) -> Gaps:
        """Return the gaps after the sequences `first` to `last` have arrived. The order of arrival does not matter."""
        left: list[tuple[int, int]] = []
        if last + 1 < self.first:
            left.append((last + 1, self.first - 1))
        for a, b in self.ranges:
            if a < first:
                left.append((a, min(b, first - 1)))
            if b > last:
                left.append((max(a, last + 1), b))
        if self.last + 1 < first:
            left.append((self.last + 1, first - 1))
        return Gaps(min(self.first, first), max(self.last, last), tuple(left[-MAX_RANGES:]))

    def may_contain(self, sequence: int) -> bool:
        """Return whether a sequence may have arrived. It has not if it lies in a gap."""
        return self.first <= sequence <= self.last and not any(a <= sequence <= b for a, b in self.ranges)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON for a stream's row, which stores `last` in its own column."""
        return {"first": self.first, "ranges": [list(pair) for pair in self.ranges]}

    @staticmethod
    def from_json(missing: dict[str, Any], last: int) -> Gaps:
        """Read what `to_json` wrote."""
        return Gaps(missing["first"], last, tuple((a, b) for a, b in missing["ranges"]))


def is_forgotten(source: StreamRow, sequence: int) -> bool:
    """Return whether the batch of a sequence may have arrived and been deleted since."""
    gaps = Gaps.from_json(source.missing, source.last)
    return source.forgotten is not None and sequence <= source.forgotten and gaps.may_contain(sequence)


def note_arrival(session: Session, model: str, batch: NewBatch, max_streams: int | None) -> StreamRow:
    """Store in the row of a stream which sequences have arrived, and return the row. A new stream gets a new row."""
    source = session.get(StreamRow, (model, batch.stream_id))
    if source is None:
        _check_new(session, model, batch)
        if max_streams is not None:
            _make_room(session, model, max_streams, batch.received)
        source = StreamRow(model=model, stream_id=batch.stream_id, kind=batch.kind, offset=batch.offset)
        source.created_at = now()
        gaps = Gaps(batch.sequence, batch.last_sequence)
        session.add(source)
    else:
        _check_stream(source, batch)
        gaps = Gaps.from_json(source.missing, source.last).arrived(batch.sequence, batch.last_sequence)
    source.offset = source.offset or batch.offset
    source.last, source.missing, source.received = gaps.last, gaps.to_json(), batch.received
    return source


def _check_new(session: Session, model: str, batch: NewBatch) -> None:
    """Raise ConflictError if the row of a silent stream was deleted and the log has later batches of the stream."""
    of_stream = EventRow.model == model, EventRow.stream_id == batch.stream_id
    last = session.scalar(select(func.max(EventRow.last_sequence)).where(*of_stream))
    if last is not None and batch.sequence <= last:
        raise ConflictError(
            f"stream {batch.stream_id!r} was silent so long that its record, up to batch {last}, was deleted: continue "
            "with higher sequences, or with another stream_id"
        )


def _make_room(session: Session, model: str, most: int, received: float) -> None:
    """Delete the stream that was silent longest if there are too many. Raise BusyError if all are in use."""
    of_model = StreamRow.model == model
    known = session.scalar(select(func.count()).select_from(StreamRow).where(of_model)) or 0
    if known < most:
        return
    used = func.coalesce(StreamRow.received, 0.0)
    silent = case((used > received + MIN_SILENT_S, 0.0), else_=used)  # stamped before the clock was set back
    oldest = session.scalars(select(StreamRow).where(of_model).order_by(silent).limit(1)).one()
    if abs((oldest.received or 0.0) - received) < MIN_SILENT_S:
        raise BusyError(f"model {model!r} already has {known} active streams, the max: use one of their stream_ids")
    session.delete(oldest)
    session.flush()


def check_kind(source: StreamRow | None, kind: StreamKind) -> None:
    """Raise ConflictError if a stream is of the other kind: a sequence counts either batches or frames."""
    if source is not None and source.kind != kind:
        name = f"stream {source.stream_id!r} of model {source.model!r}"
        raise ConflictError(f"{name} consists of {source.kind}, not {kind}: use another stream_id")


def _check_stream(source: StreamRow, batch: NewBatch) -> None:
    name = f"stream {source.stream_id!r} of model {source.model!r}"
    check_kind(source, batch.kind)
    if batch.kind == "frames" and batch.sequence <= source.last:
        raise ConflictError(f"{name} has reached frame {source.last}: frame {batch.sequence} is not newer")
    if is_forgotten(source, batch.sequence):
        raise ConflictError(
            f"batch {batch.sequence} of {name} may be a repetition: batches that old are no longer kept"
        )
