"""Define what judging stores per model, and what the log stores per judgement, to continue from batch to batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.adaptive import AdaptiveScale
from lipcore.online.batch import Rows
from lipcore.online.changes.departure import Departure
from lipcore.online.changes.detectors import Change, ChangeDetector, friction_share
from lipcore.online.record import Record
from lipcore.online.scale import IntervalCoverage

MAX_INNOVATION_ROWS = 1000
"""Rows with stored innovations, to distinguish friction from a payload."""


@dataclass(frozen=True)
class Innovations:
    """The latest predicted rows: event time (N,) s, dq (N, n), error = tau − mean (N, n)."""

    time: Array
    dq: Array
    error: Array

    @staticmethod
    def empty(n: int) -> Innovations:
        """Return no innovations of n joints."""
        return Innovations(np.empty(0), np.empty((0, n)), np.empty((0, n)))

    def append(self, rows: Rows, mean: Array) -> Innovations:
        """Return the latest innovations after more rows."""
        new = rows.time, rows.dq, rows.tau - mean
        old = self.time, self.dq, self.error
        return Innovations(*(np.concatenate(both)[-MAX_INNOVATION_ROWS:] for both in zip(old, new, strict=True)))

    def friction(self, since: float) -> Array:
        """Return the share of friction in the innovations since an event time, (n,)."""
        late = self.time >= since
        return friction_share(self.dq[late], self.error[late])


@dataclass(frozen=True)
class LoggedJudgement:
    """What the log stores about a batch besides its rows and their record."""

    held: bool
    """Whether its rows await a decision about a change."""
    waited: bool
    """Whether learning was paused before the batch."""
    open: bool
    """Whether the stream's contact gate is open."""
    doubted: bool
    """Whether the stream has not fitted since its first second."""
    aside: bool
    """Whether no row of the batch is learnt."""
    until: float | None
    """Latest event time of the predicted rows, s; None if there are none."""
    departure: Departure | None
    """Departure of the model after the batch."""
    surprise: Array | None
    """Mean of e²/s², (n,), see `ChangeFindings.surprise`."""
    answered: IntervalCoverage | None
    """Coverage of the intervals that were returned; None if intervals do not adapt."""
    accepted_scale: AdaptiveScale | None
    """Scale for queries without this stream; None if intervals do not adapt."""

    def to_json(self) -> dict[str, Any]:
        """Return the fields as the log stores them; `from_json` restores them to the last bit."""
        adaptive = {name: each.to_json() for name in ADAPTIVE_FIELDS if (each := getattr(self, name)) is not None}
        return {
            **{name: getattr(self, name) for name in ("held", "waited", "open", "doubted", "aside", "until")},
            "departure": None if self.departure is None else self.departure.to_json(),
            "surprise": None if self.surprise is None else self.surprise.tolist(),
            **adaptive,
        }

    @staticmethod
    def from_json(report: Mapping[str, Any]) -> LoggedJudgement:
        """Read what `to_json` returned; release 0.2.0 did not store `doubted`, `aside` and `accepted_scale`."""
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
            None if answered is None else IntervalCoverage.from_json(answered),
            None if scale is None else AdaptiveScale.from_json(scale),
        )


ADAPTIVE_FIELDS = ("answered", "accepted_scale")


@dataclass(frozen=True)
class ModelRecord:
    """The record of a learning model after its last batch, of whichever stream; immutable."""

    innovations: Innovations
    """Innovations of the batches of this service: the log stores no predictions."""
    detector: ChangeDetector = field(default_factory=ChangeDetector)
    """Detects errors that grow."""
    departure: Departure | None = None
    """Departure from the version as trained; None before the first batch."""
    held: bool = False
    """Whether learning is paused until a change is decided about."""

    def step(self, record: Record, surprise: Array, until: float) -> tuple[ModelRecord, Change | None]:
        """Pass the record of a batch to the detector; return the model's record and the change found."""
        detector, change = self.detector.step(replace(record, standardised=surprise), until)
        return replace(self, detector=detector), change

    def settled(self, logged: LoggedJudgement) -> ModelRecord:
        """Return the record after the decision about a batch."""
        waits = logged.held or logged.open or logged.until is None
        detector = self.detector if waits else self.detector.acknowledged()
        return replace(self, detector=detector, departure=logged.departure, held=logged.held)

    def follow(self, logged: LoggedJudgement, record: Record | None, recent: bool) -> ModelRecord:
        """Return the record after a batch that was judged by another process or before a restart.

        recent: whether the batch is still within the detector's window.
        """
        before = self.decided() if self.held and not logged.waited else self
        if not recent:
            return replace(before, departure=logged.departure, held=logged.held)
        if record is not None and logged.surprise is not None and logged.until is not None:
            before, _ = before.step(record, logged.surprise, logged.until)
        return before.settled(logged)

    def decided(self) -> ModelRecord:
        """Return the record after the change was decided about."""
        return replace(self, held=False, departure=self.departure and self.departure.decided())

    def moved(self, step: float) -> ModelRecord:
        """Return the record after the clock was set by `step`, s."""
        return replace(self, detector=self.detector.moved(step))
