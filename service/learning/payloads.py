"""What the streams of a model carry, as its versions see it: made from the streams' records."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.payload.estimate import Estimate
from lipcore.online.payload.holding import Watch
from lipcore.online.stream import PayloadRecord
from lipcore.vocabulary import Code
from service.journal import log
from service.learning.streams import Streams
from service.models.loads import Carried
from service.storage.database import EventRow

MOST_BATCHES = 40
"""That are read again to know what a stream carries."""
TEACHING = [Code.LEARNT, Code.PAYLOAD]
"""Codes of rows that tell of a payload."""


@dataclass(frozen=True)
class Seen:
    """A record as a version sees it. carrier: that it was made for, None where rows have been followed with it."""

    record: PayloadRecord
    version: int
    carrier: Carrier | None
    watch: Watch

    def fits(self, carrier: Carrier, version: int) -> bool:
        """Whether it is what this version sees."""
        return self.version == version and (self.carrier is None or self.carrier is carrier)


class Payloads:
    """The payloads of one model's streams, for any thread. streams: their records."""

    def __init__(self, streams: Streams) -> None:
        self._streams, self._lock = streams, threading.Lock()
        self._seen: dict[str, Seen] = {}
        self._rows: dict[str, tuple[PayloadRecord, Rows]] = {}
        self._models: dict[str, tuple[Estimate, Carrier, TorqueModel]] = {}

    @classmethod
    def restored(cls, session: Session, model: str, streams: Streams) -> Payloads:
        """Those of records that were read from the database, with the rows that noticed payloads were seen on."""
        made = cls(streams)
        for stream_id, record in streams.all().items():
            payload = record.payload
            if payload is None or payload.watch is None or (held := payload.watch["held"]) is None or held["declared"]:
                continue
            rows = _seen_on(session, model, stream_id, float(payload.watch["since"]))
            if rows is not None:
                made._rows[stream_id] = payload, rows
        return made

    def event(self, stream_id: str) -> int:
        """Number of the event that says what a stream carries, at least that with which it began."""
        record = self._streams.payload(stream_id)
        return max(self._streams.get(stream_id).begun, 0 if record is None else record.event)

    def watch(self, stream_id: str, carrier: Carrier, version: int) -> Watch:
        """What a stream carries, as a version sees it; what was declared for all streams where it is ""."""
        record = self._streams.payload(stream_id)
        if record is None:
            return Watch(carrier.model.n_joints)
        with self._lock:
            seen = self._seen.get(stream_id)
            # the same watch for as long as it is asked for: models that answer are made for it
            if seen is not None and seen.record is record and seen.fits(carrier, version):
                return seen.watch
            known = self._rows.get(stream_id)
            rows = None if known is None or known[0] is not record else known[1]
            watch = record.seen_by(carrier, version, rows)
            self._seen[stream_id] = Seen(record, version, carrier, watch)
            return watch

    def take(self, stream_id: str, watch: Watch, version: int, received: float, event: int) -> bool:
        """Keep what a stream carries, seen with the latest rows of `received`; not where its owner has said something
        since event `event`. Return whether it is kept."""
        with self._lock:
            if self.event(stream_id) != event:
                return False
            record = PayloadRecord(event, received, watch.to_json(), version)
            self._streams.change(stream_id, payload=record)
            self._seen[stream_id] = Seen(record, version, None, watch)
            return True

    def carried(self, carrier: Carrier, version: int) -> dict[str, Carried]:
        """What answers for each stream; with None for its model where nothing is carried. The default is that of ""."""
        received = {name: record.received for name, record in self._streams.all().items()}
        if self._streams.default is not None:
            received[""] = self._streams.default.received
        with self._lock:
            for gone in self._seen.keys() - received.keys():
                del self._seen[gone]
            self._rows = {name: each for name, each in self._rows.items() if name in received}
            self._models = {name: each for name, each in self._models.items() if name in received}
        out: dict[str, Carried] = {}
        for stream_id, at in received.items():  # without the lock: a model takes milliseconds to make
            held = self.watch(stream_id, carrier, version).held
            if held is None:
                out[stream_id] = Carried(None, None, at)
            else:
                model = self._answering(stream_id, held.estimate, carrier)
                out[stream_id] = Carried(model, held.estimate.mass, at)
        return out

    def _answering(self, stream_id: str, estimate: Estimate, carrier: Carrier) -> TorqueModel:
        known = self._models.get(stream_id)
        if known is not None and known[0] is estimate and known[1] is carrier:
            return known[2]
        model = carrier.carrying(estimate.load)
        model.answer(np.zeros((3, model.n_joints)))  # whoever asks next does not wait for it to be laid out
        self._models[stream_id] = estimate, carrier, model
        return model


def _seen_on(session: Session, model: str, stream_id: str, since: float) -> Rows | None:
    """Rows of a stream since an event time, s, of as many batches as are read, evenly spread; None without any."""
    of_stream = EventRow.model == model, EventRow.stream_id == stream_id, EventRow.kind == "batch"
    since_then = select(EventRow.number).where(*of_stream, EventRow.last >= since).order_by(EventRow.number)
    numbers = list(session.scalars(since_then))
    places = np.unique(np.linspace(0, len(numbers) - 1, min(len(numbers), MOST_BATCHES)).round().astype(int))
    chosen = EventRow.model == model, EventRow.number.in_([numbers[place] for place in places])
    parts = [log.rows_of(event) for event in session.scalars(select(EventRow).where(*chosen))]
    if not parts:
        return None
    rows = Rows.concatenate(parts)
    rows = rows.take(np.isin(rows.code, TEACHING) & (rows.time >= since))
    return rows.take(np.argsort(rows.time, kind="stable")) if len(rows) else None
