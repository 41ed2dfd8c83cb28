"""What is known of a stream after its last batch: one immutable record, which lasts over restarts, other versions,
rollbacks and the retention of the log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.changes.opening import Opening
from lipcore.online.gates import ContactGate
from lipcore.online.payload.holding import Watch
from lipcore.online.scale import ScaleRecord

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

    def seen_by(self, carrier: Carrier, version: int, rows: Rows | None = None) -> Watch:
        """Return the payload as a version sees it. One whose geometry was learnt has a frame of its own, in which a
        payload that another version has seen lies elsewhere. rows: that the payload was seen on, None if unknown."""
        n, noticed, body = carrier.model.n_joints, self.watch, self.body
        if noticed is not None:
            if carrier.term.arm.mode == "learn" and self.version != version:
                return Watch.of_another(noticed, n, carrier)
            return Watch.from_json(noticed, n, carrier, rows)
        if body is None:
            return Watch(n).put_down(self.received)
        inertia = None if body["inertia"] is None else np.array(body["inertia"])
        return Watch(n).declare(carrier, Body(body["mass"], np.array(body["com"]), inertia), self.received)

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

    gate: ContactGate = field(default_factory=ContactGate.start)
    opening: Opening | None = None
    doubted: bool = False
    scale: ScaleRecord | None = None
    payload: PayloadRecord | None = None
    leapt: bool = False
    begun: int = 0
    received: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return what the stream's row keeps: all but `received`, which has a column."""
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
    def start(cls, n: int) -> StreamRecord:
        """Return the record of a stream of n joints that has just begun."""
        return cls(opening=Opening.start(n))

    @classmethod
    def from_json(cls, values: Mapping[str, Any] | None, received: float) -> StreamRecord:
        """Read what `to_json` returned, or None, which a service of an earlier release has left."""
        if values is None:
            return cls(received=received)
        opening, scale, payload = (values[name] for name in ("opening", "scale", "payload"))
        return cls(
            ContactGate.from_json(values["gate"]),
            None if opening is None else Opening.from_json(opening),
            values["doubted"],
            None if scale is None else ScaleRecord.from_json(scale),
            None if payload is None else PayloadRecord(**payload),
            values["leapt"],
            values["begun"],
            received,
        )
