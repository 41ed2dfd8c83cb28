"""What judging knows of a model, and what the log keeps of a judgement: enough to follow it from batch to batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.adaptive import Adaptive
from lipcore.online.batch import Rows
from lipcore.online.changes.departure import Departure
from lipcore.online.changes.detectors import Change, ChangeDetector, friction_share
from lipcore.online.record import Record
from lipcore.online.scale import HeldIntervals

MOST_INNOVATIONS = 1000
"""Rows whose innovations are kept to tell friction from a payload."""


@dataclass(frozen=True)
class Innovations:
    """The latest rows that were predicted: event time (N,) s, dq (N, n), error = tau − mean (N, n)."""

    time: Array
    dq: Array
    error: Array

    @staticmethod
    def empty(n: int) -> Innovations:
        """None yet, of n joints."""
        return Innovations(np.empty(0), np.empty((0, n)), np.empty((0, n)))

    def then(self, rows: Rows, mean: Array) -> Innovations:
        """Those of more rows, and as many of the ones before as are kept."""
        new = rows.time, rows.dq, rows.tau - mean
        old = self.time, self.dq, self.error
        return Innovations(*(np.concatenate(both)[-MOST_INNOVATIONS:] for both in zip(old, new, strict=True)))

    def friction(self, since: float) -> Array:
        """Share of friction in those from an event time on, (n,)."""
        late = self.time >= since
        return friction_share(self.dq[late], self.error[late])


@dataclass(frozen=True)
class LoggedJudgement:
    """What the log keeps of the judgement of a batch beside its rows and their record.

    held: whether its rows wait for a decision about a change; waited: whether learning waited before it. open: whether
    the stream's gate stands back. doubted: whether the stream did not fit from its first second on; aside: whether
    nothing of it is learnt. until: latest event time of its predicted rows, s, None without any. departure: of the
    model, after it. surprise: mean of e²/s² of the rows that count, (n,), see `Found`. answered: what intervals held;
    accepted_scale: what others are answered with; None of both if intervals do not adapt.
    """

    held: bool
    waited: bool
    open: bool
    doubted: bool
    aside: bool
    until: float | None
    departure: Departure | None
    surprise: Array | None
    answered: HeldIntervals | None
    accepted_scale: Adaptive | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields as the log keeps them; `from_json` returns the same to the last bit."""
        adaptive = {name: each.to_json() for name in ADAPTIVE if (each := getattr(self, name)) is not None}
        return {
            **{name: getattr(self, name) for name in ("held", "waited", "open", "doubted", "aside", "until")},
            "departure": None if self.departure is None else self.departure.to_json(),
            "surprise": None if self.surprise is None else self.surprise.tolist(),
            **adaptive,
        }

    @staticmethod
    def from_json(report: Mapping[str, Any]) -> LoggedJudgement:
        """Read what `to_json` returned, from all that the log keeps of a batch. Release 0.2.0 did not keep `doubted`,
        `aside` and `accepted_scale`."""
        departure, surprise, answered, scale = (
            report.get(name) for name in ("departure", "surprise", "answered", "accepted_scale")
        )
        return LoggedJudgement(
            report["held"],
            report["waited"],
            report["open"],
            report.get("doubted", False),
            report.get("aside", False),
            report["until"],
            None if departure is None else Departure.from_json(departure),
            None if surprise is None else np.array(surprise, np.float64),
            None if answered is None else HeldIntervals.from_json(answered),
            None if scale is None else Adaptive.from_json(scale),
        )


ADAPTIVE = ("answered", "accepted_scale")


@dataclass(frozen=True)
class ModelRecord:
    """What is known of a model that learns after its last batch, whichever stream it came from; immutable.

    held: whether learning waits for a decision about a change; detector: of errors that grow; departure: from the
    version as trained, None before the first batch; innovations: those of this service's own batches, as the log has no
    predictions.
    """

    innovations: Innovations
    detector: ChangeDetector = field(default_factory=ChangeDetector)
    departure: Departure | None = None
    held: bool = False

    def step(self, record: Record, surprise: Array, until: float) -> tuple[ModelRecord, Change | None]:
        """Let the detector take in the record of a batch, and return the change that it finds."""
        detector, change = self.detector.step(replace(record, standardised=surprise), until)
        return replace(self, detector=detector), change

    def settled(self, logged: LoggedJudgement) -> ModelRecord:
        """Return the record once a batch was decided about."""
        waits = logged.held or logged.open or logged.until is None
        detector = self.detector if waits else self.detector.acknowledged()
        return replace(self, detector=detector, departure=logged.departure, held=logged.held)

    def follow(self, logged: LoggedJudgement, record: Record | None, recent: bool) -> ModelRecord:
        """Return the record after a batch that was judged elsewhere, or before a restart. recent: whether the detector
        still looks back to it."""
        before = self.decided() if self.held and not logged.waited else self
        if not recent:
            return replace(before, departure=logged.departure, held=logged.held)
        if record is not None and logged.surprise is not None and logged.until is not None:
            before, _ = before.step(record, logged.surprise, logged.until)
        return before.settled(logged)

    def decided(self) -> ModelRecord:
        """Return the record once the hold has ended."""
        return replace(self, held=False, departure=self.departure and self.departure.decided())

    def moved(self, step: float) -> ModelRecord:
        """Return the record by a clock that was set by `step`, s."""
        return replace(self, detector=self.detector.moved(step))
