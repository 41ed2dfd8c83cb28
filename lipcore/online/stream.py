"""The record of a stream after its last batch. It outlives restarts, other versions, rollbacks and log retention."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lipcore.kernels.drive.play import PlayState
from lipcore.model.body import Body
from lipcore.model.payload import Carrier
from lipcore.online.batch import Rows
from lipcore.online.changes.opening import Opening
from lipcore.online.gates import ContactGate
from lipcore.online.payload.holding import PayloadTracker
from lipcore.online.scale import ScaleRecord

FORMAT = 1
"""Format of a record's JSON. A later release that changes it can still read this one."""


@dataclass(frozen=True)
class PayloadRecord:
    """The latest known payload of a stream, declared or noticed."""

    event: int
    """Number of the event that declared or noticed it."""
    received: float
    """Unix time of the latest rows that show it, s."""
    watch: Mapping[str, Any] | None = None
    """The estimate by `version`, see `PayloadTracker.to_json`; None for a declaration."""
    version: int | None = None
    body: Mapping[str, Any] | None = None
    """The declared body; None for no payload."""

    @property
    def has_payload(self) -> bool:
        """Whether the arm carries a payload."""
        return self.body is not None or (self.watch is not None and self.watch["held"] is not None)

    def build_tracker(self, carrier: Carrier, version: int, rows: Rows | None = None) -> PayloadTracker:
        """Return the payload in the frame of a version.

        A version with learnt geometry has its own frame, in which a payload noticed by another version lies elsewhere.
        rows: in which the payload was noticed, None if unknown.
        """
        n, noticed, body = carrier.model.n_joints, self.watch, self.body
        if noticed is not None:
            if carrier.term.arm.mode == "learn" and self.version != version:
                return PayloadTracker.from_other_version(noticed, n, carrier)
            return PayloadTracker.from_json(noticed, n, carrier, rows)
        if body is None:
            return PayloadTracker(n).put_down(self.received)
        inertia = None if body["inertia"] is None else np.array(body["inertia"])
        return PayloadTracker(n).declare(carrier, Body(body["mass"], np.array(body["com"]), inertia), self.received)

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON; `PayloadRecord(**values)` reads them."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


@dataclass(frozen=True)
class StreamRecord:
    """The record of a stream after its last batch; immutable."""

    gate: ContactGate = field(default_factory=ContactGate.start)
    """The gate that rejects contacts."""
    opening: Opening | None = None
    """The stream's first second; None once that is judged."""
    doubted: bool = False
    """Whether the first second did not fit and nobody has confirmed the stream since."""
    scale: ScaleRecord | None = None
    """Scale of the stream's intervals; None if they do not adapt."""
    payload: PayloadRecord | None = None
    """The payload; None if none was declared or noticed."""
    leapt: bool = False
    """Whether its clock has jumped ahead of the arrival of its rows."""
    begun: int = 0
    """Number of the event of its first batch."""
    play: PlayState | None = None
    """The deflections after its last row; None if they are unknown."""
    received: float = 0.0
    """When the last batch arrived, Unix time, s."""

    def to_json(self) -> dict[str, Any]:
        """Return what the stream's database row stores: all but `received`, which has a column."""
        return {
            "format": FORMAT,
            "gate": self.gate.to_json(),
            "opening": None if self.opening is None else self.opening.to_json(),
            "doubted": self.doubted,
            "scale": None if self.scale is None else self.scale.to_json(),
            "payload": None if self.payload is None else self.payload.to_json(),
            "leapt": self.leapt,
            "begun": self.begun,
            "play": None if self.play is None else self.play.packed.tolist(),
        }

    def decided(self) -> StreamRecord:
        """Return the record after a decision: what has changed is no contact, so the gate opens."""
        return replace(self, gate=self.gate.let_all_pass())

    @classmethod
    def start(cls, n: int) -> StreamRecord:
        """Return the record of a new stream of n joints."""
        return cls(opening=Opening.start(n))

    @classmethod
    def from_json(cls, values: Mapping[str, Any] | None, received: float) -> StreamRecord:
        """Read what `to_json` returned, or None, which an earlier release has stored."""
        if values is None:
            return cls(received=received)
        opening, scale, payload, play = (values.get(name) for name in ("opening", "scale", "payload", "play"))
        return cls(
            ContactGate.from_json(values["gate"]),
            None if opening is None else Opening.from_json(opening),
            values["doubted"],
            None if scale is None else ScaleRecord.from_json(scale),
            None if payload is None else PayloadRecord(**payload),
            values["leapt"],
            values["begun"],
            None if play is None else PlayState(np.array(play, np.float64)),
            received,
        )
