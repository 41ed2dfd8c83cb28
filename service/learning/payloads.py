"""What the streams of a model carry: followed batch by batch, declared by its owner, taken up again from the log."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.estimate import Estimate
from lipcore.online.holding import Watch
from lipcore.vocabulary import CODES, LEARNT
from service.journal import log
from service.models.loads import Carried
from service.storage.database import EventRow

MOST_EVENTS = 3000
"""Of the log's newest, among which the last batch of a stream is looked for."""
MOST_BATCHES = 40
"""That are read again to know what a stream carries."""
TEACHING = [LEARNT, CODES.index("payload")]
"""Codes of rows that tell of a payload."""


@dataclass
class Noted:
    """What the log says of a stream: a batch's report, what was noticed, or a declaration. version: that predicted it,
    None for a declaration; received: Unix time, s; rows: that a payload was seen on, where they were looked for."""

    values: Mapping[str, Any]
    version: int | None
    received: float
    rows: Rows | None = None
    _seen: tuple[Carrier, int, Watch] | None = field(default=None, init=False)

    def watch(self, carrier: Carrier, version: int) -> Watch:
        """The watch of the stream from there on, of a version: the same one for as long as that is asked for, as models
        that answer are made for it. A version whose geometry was learnt has a frame of its own, in which a payload that
        another one has seen lies elsewhere."""
        seen = self._seen
        if seen is None or seen[0] is not carrier or seen[1] != version:
            self._seen = seen = carrier, version, self._made(carrier, version)
        return seen[2]

    def _made(self, carrier: Carrier, version: int) -> Watch:
        n = carrier.model.n_joints
        learnt = carrier.term.arm.mode == "learn"
        if learnt and self.version not in (None, version):
            return Watch.of_another(self.values, n, carrier)
        if "body" not in self.values:
            return Watch.from_json(self.values, n, carrier, self.rows)
        body = self.values["body"]
        return (
            Watch(n).put_down(self.received) if body is None else Watch(n).declare(carrier, _body(body), self.received)
        )


@dataclass(frozen=True)
class Watched:
    """A stream's watch after its last batch, which a version predicted and which came at `received`, Unix time, s."""

    watch: Watch
    version: int
    received: float


class Payloads:
    """The watches of one model's streams, made from what the log says when they are first needed; for any thread."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._noted: dict[str, Noted] = {}
        self._default: Noted | None = None
        self._watches: dict[str, Watched] = {}
        self._models: dict[str, tuple[Estimate, Carrier, TorqueModel]] = {}
        self._said: dict[str | None, int] = {}

    @classmethod
    def restored(cls, session: Session, model: str) -> Payloads:
        """Those of a model, by the last batch of each stream and what was declared since."""
        made = cls()
        newest = select(func.max(EventRow.number)).where(EventRow.model == model).scalar_subquery()
        recent = EventRow.model == model, EventRow.number > newest - MOST_EVENTS
        last = select(func.max(EventRow.number)).where(*recent, EventRow.kind == "batch").group_by(EventRow.stream_id)
        declared = (EventRow.model == model, EventRow.kind == "payload")
        batches = session.scalars(select(EventRow).where(EventRow.model == model, EventRow.number.in_(last)))
        events = [*batches, *session.scalars(select(EventRow).where(*declared))]
        for event in sorted(events, key=lambda each: each.number):
            made.remember(event)
        for stream_id, noted in made._noted.items():
            held = noted.values.get("held")
            if held is not None and not held["declared"]:
                rows = _seen_on(session, model, stream_id, float(noted.values["since"]))
                made._noted[stream_id] = replace(noted, rows=rows)
        return made

    def remember(self, event: EventRow) -> None:
        """Take in what an event of the log says."""
        detail = event.detail or {}
        with self._lock:
            if event.kind == "payload" and "watch" in detail:
                self._forget(detail["stream_id"])
                self._noted[detail["stream_id"]] = Noted(detail["watch"], event.version, event.received)
                self._said[detail["stream_id"]] = event.number
            elif event.kind == "payload":
                noted, stream_id = Noted(detail, None, event.received), detail["stream_id"]
                self._said[stream_id] = event.number
                if stream_id is None:
                    self._default = noted
                    self._noted = dict.fromkeys({*self._noted, *self._watches}, noted)
                    self._watches = {}
                else:
                    self._forget(stream_id)
                    self._noted[stream_id] = noted
            elif event.stream_id is not None and (values := (event.report or {}).get("payload")) is not None:
                self._noted[event.stream_id] = Noted(values, event.version, event.received)

    def said(self, stream_id: str) -> int:
        """Number of the event that says what a stream carries: the owner's last one, or what another service, or this
        one before it was started, has noticed since; 0 before the first."""
        return max(self._said.get(stream_id, 0), self._said.get(None, 0))

    def watch(self, stream_id: str, carrier: Carrier, version: int) -> Watch:
        """The watch of a stream before its next rows, which a version predicts."""
        with self._lock:
            if (known := self._watches.get(stream_id)) is not None and known.version == version:
                return known.watch
            noted = self._noted.get(stream_id, self._default)
            return Watch(carrier.model.n_joints) if noted is None else noted.watch(carrier, version)

    def take(self, stream_id: str, watch: Watch, version: int, received: float, said: int) -> bool:
        """Keep what a stream carries, seen with the latest rows of `received`; not where its owner has said something
        since event `said`. Return whether it is kept."""
        with self._lock:
            if self.said(stream_id) != said:
                return False
            self._watches[stream_id] = Watched(watch, version, received)
            self._noted[stream_id] = Noted(watch.to_json(), version, received)  # for other versions
            return True

    def came(self, stream_id: str, carrier: Carrier, version: int, received: float) -> Watch:
        """Note that rows of a stream have come, which a version has predicted; return its watch."""
        with self._lock:
            watch = self.watch(stream_id, carrier, version)
            self._watches[stream_id] = Watched(watch, version, received)
            return watch

    def forget(self, stream_id: str) -> None:
        """Keep nothing of a stream."""
        with self._lock:
            self._forget(stream_id)

    def _forget(self, stream_id: str) -> None:
        for kept in (self._noted, self._models, self._watches):
            kept.pop(stream_id, None)

    def all(self, carrier: Carrier, version: int) -> dict[str, tuple[Watch, float]]:
        """Watches by stream as a version sees them, and when what they know came, Unix time, s."""
        with self._lock:
            out = {name: (each.watch(carrier, version), each.received) for name, each in self._noted.items()}
            seen = {name: each for name, each in self._watches.items() if each.version == version}
            return out | {name: (each.watch, each.received) for name, each in seen.items()}

    def carried(self, carrier: Carrier, version: int) -> dict[str, Carried]:
        """What answers for each stream; with None for its model where nothing is carried. The default is that of ""."""
        with self._lock:
            watches = self.all(carrier, version)
            if self._default is not None:
                watches[""] = self._default.watch(carrier, version), self._default.received
        out: dict[str, Carried] = {}
        for stream_id, (watch, received) in watches.items():  # without the lock: a model takes milliseconds to make
            if watch.held is None:
                out[stream_id] = Carried(None, None, received)
            else:
                estimate = watch.held.estimate
                out[stream_id] = Carried(self._answering(stream_id, estimate, carrier), estimate.mass, received)
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


def _body(values: Mapping[str, Any]) -> Body:
    inertia = values["inertia"]
    return Body(values["mass"], np.array(values["com"]), None if inertia is None else np.array(inertia))
