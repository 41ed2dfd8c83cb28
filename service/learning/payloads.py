"""The payloads of a model's streams as its versions see them, made from the streams' records."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.data.motion import spaced_rows
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.payload.estimate import Estimate
from lipcore.online.payload.holding import PayloadTracker
from lipcore.online.stream import PayloadRecord
from lipcore.vocabulary import Code
from service.journal import log
from service.learning.streams import Streams
from service.models.loads import StreamPayload
from service.storage.database import EventRow

MAX_BATCHES = 40
"""Max batches of a stream that are read from the log to restore its payload."""
PAYLOAD_CODES = [Code.LEARNT, Code.PAYLOAD]
"""Codes of rows that show a payload."""


@dataclass(frozen=True)
class PayloadView:
    """A payload record as a version sees it."""

    record: PayloadRecord
    version: int
    carrier: Carrier | None
    """Carrier for which the watch was made; None if the weigher process made it from rows."""
    watch: PayloadTracker

    def fits(self, carrier: Carrier, version: int) -> bool:
        """Return whether this is the view of a version."""
        return self.version == version and (self.carrier is None or self.carrier is carrier)


class Payloads:
    """The payloads of one model's streams, safe from several threads. streams: their records."""

    def __init__(self, streams: Streams) -> None:
        self._streams, self._lock = streams, threading.Lock()
        self._views: dict[str, PayloadView] = {}
        self._rows: dict[str, tuple[PayloadRecord, Rows]] = {}
        self._models: dict[str, tuple[Estimate, Carrier, TorqueModel]] = {}

    @classmethod
    def restored(cls, session: Session, model: str, streams: Streams) -> Payloads:
        """Return the payloads of stored records, with the rows that show the noticed ones."""
        made = cls(streams)
        for stream_id, record in streams.all().items():
            payload = record.payload
            if payload is None or payload.watch is None or (held := payload.watch["held"]) is None or held["declared"]:
                continue
            rows = _read_rows(session, model, stream_id, float(payload.watch["since"]))
            if rows is not None:
                made._rows[stream_id] = payload, rows
        return made

    def find_event(self, stream_id: str) -> int:
        """Return the number of the event that set a stream's payload, or that of its first batch if later."""
        record = self._streams.payload(stream_id)
        return max(self._streams.get(stream_id).begun, 0 if record is None else record.event)

    def watch(self, stream_id: str, carrier: Carrier, version: int) -> PayloadTracker:
        """Return the payload of a stream as a version sees it; for "" the payload declared for all streams."""
        record = self._streams.payload(stream_id)
        if record is None:
            return PayloadTracker(carrier.model.n_joints)
        with self._lock:
            seen = self._views.get(stream_id)
            # return the same object each time: models are cached by its estimate
            if seen is not None and seen.record is record and seen.fits(carrier, version):
                return seen.watch
            known = self._rows.get(stream_id)
            rows = None if known is None or known[0] is not record else known[1]
            watch = record.build_tracker(carrier, version, rows)
            self._views[stream_id] = PayloadView(record, version, carrier, watch)
            return watch

    def store(self, stream_id: str, watch: PayloadTracker, version: int, received: float, event: int) -> bool:
        """Store the payload of a stream, seen with rows of `received`, and return whether it was stored.

        It is not stored if its owner has declared another payload since event `event`.
        """
        with self._lock:
            if self.find_event(stream_id) != event:
                return False
            record = PayloadRecord(event, received, watch.to_json(), version)
            self._streams.change(stream_id, payload=record)
            self._views[stream_id] = PayloadView(record, version, None, watch)
            return True

    def build_models(self, carrier: Carrier, version: int) -> dict[str, StreamPayload]:
        """Return the model that answers each stream, None for one without a payload. The default has the name ""."""
        received = {name: record.received for name, record in self._streams.all().items()}
        if self._streams.default is not None:
            received[""] = self._streams.default.received
        with self._lock:
            for gone in self._views.keys() - received.keys():
                del self._views[gone]
            self._rows = {name: each for name, each in self._rows.items() if name in received}
            self._models = {name: each for name, each in self._models.items() if name in received}
        out: dict[str, StreamPayload] = {}
        for stream_id, at in received.items():  # without the lock: building a model takes milliseconds
            held = self.watch(stream_id, carrier, version).held
            if held is None:
                out[stream_id] = StreamPayload(None, None, at)
            else:
                model = self._answering(stream_id, held.estimate, carrier)
                out[stream_id] = StreamPayload(model, held.estimate.mass, at)
        return out

    def _answering(self, stream_id: str, estimate: Estimate, carrier: Carrier) -> TorqueModel:
        known = self._models.get(stream_id)
        if known is not None and known[0] is estimate and known[1] is carrier:
            return known[2]
        model = carrier.with_payload(estimate.load)
        model.answer(np.zeros((3, model.n_joints)))  # lays out its arrays, so that the first request need not wait
        self._models[stream_id] = estimate, carrier, model
        return model


def _read_rows(session: Session, model: str, stream_id: str, since: float) -> Rows | None:
    """Read rows of a stream since an event time, s; None if there are none.

    If there are more than `MAX_BATCHES` batches, so many are read, evenly spread.
    """
    of_stream = EventRow.model == model, EventRow.stream_id == stream_id, EventRow.kind == "batch"
    since_then = select(EventRow.number).where(*of_stream, EventRow.last >= since).order_by(EventRow.number)
    numbers = list(session.scalars(since_then))
    places = spaced_rows(len(numbers), MAX_BATCHES)
    chosen = EventRow.model == model, EventRow.number.in_([numbers[place] for place in places])
    parts = [log.rows_of(event) for event in session.scalars(select(EventRow).where(*chosen))]
    if not parts:
        return None
    rows = Rows.concatenate(parts)
    rows = rows.take(np.isin(rows.code, PAYLOAD_CODES) & (rows.time >= since))
    return rows.take(np.argsort(rows.time, kind="stable")) if len(rows) else None
