"""Which predicted rows are learnt: contacts are not, nor what comes after a change that waits for a decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lipcore.data.samples import Array
from lipcore.online.batch import Rows
from lipcore.online.change import RATIO, Change, ChangeDetector, friction_share
from lipcore.online.gates import is_contact
from lipcore.online.record import Record
from lipcore.vocabulary import CODES, LEARNT
from service.learning.ingest.contacts import ContactGate
from service.learning.ingest.screening import Screened
from service.learning.learning_options import LearningOptions

CONTACT, CHANGE = CODES.index("contact"), CODES.index("change")
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
class Watch:
    """What the rows before say: gate of their stream, detector and innovations of the model; immutable."""

    gate: ContactGate
    detector: ChangeDetector
    innovations: Innovations


@dataclass(frozen=True)
class Verdict:
    """rows: with their final codes. record: of those that count for quality. watch: for the next rows.

    surprise: mean of e²/s² of the same rows, (n,), with s as it would be without the floor of past errors, which would
    hide from the detector what it is to find.

    change: found with these rows. held: whether these rows had to wait for a decision.
    """

    rows: Rows
    record: Record | None
    surprise: Array | None
    watch: Watch
    change: Change | None
    held: bool

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """What speaks for the change, for JSON."""
        assert self.change is not None
        return self.change.evidence(joint_names, self.watch.innovations.friction(self.change.at))


def judge(batch: Screened, watch: Watch, held: bool, options: LearningOptions, usual: Callable[[], Record]) -> Verdict:
    """Decide about the rows that were predicted. held: whether learning waits already; usual: the record of before."""
    rows = batch.rows.take(batch.predicted)
    if not len(rows):
        return Verdict(batch.rows, None, None, watch, None, held)
    contact = is_contact(rows.tau, batch.mean, batch.std, batch.noise_std, options.contact_threshold)
    gate = watch.gate if held else watch.gate.step(rows.time, contact)
    passing = held or watch.gate.open or gate.exhausted
    counted = np.ones(len(rows), np.bool_) if passing else ~contact
    everything = Record.of(rows.tau, batch.mean, batch.std, batch.noise_std)
    detector, change, record, surprise = watch.detector, None, None, None
    if counted.any():
        error, bare = (rows.tau - batch.mean)[counted], batch.bare[counted]
        record = Record.of(rows.tau[counted], batch.mean[counted], batch.std[counted], batch.noise_std)
        surprise = (error**2 / (bare**2 + batch.noise_std**2)).mean(axis=0)
        detector, change = detector.step(replace(record, standardised=surprise), float(rows.time.max()))
    if held or watch.gate.open:
        change = None  # what follows a change that is known
    elif change is None and gate.exhausted:
        change = _lasting(gate, everything, usual(), rows)
    if change is not None and options.on_change == "hold":
        held = True
    elif change is not None:
        gate = gate.stand_back()
    if not held and not gate.open:
        detector = detector.acknowledged()
    codes = batch.rows.code.copy()
    learnt = np.where(contact & (not (passing or gate.open)), CONTACT, LEARNT)
    codes[batch.predicted] = CHANGE if held else learnt
    judged = replace(batch.rows, code=codes)
    following = Watch(gate, detector, watch.innovations.then(rows, batch.mean))
    return Verdict(judged, record, surprise, following, change, held)


def _lasting(gate: ContactGate, record: Record, usual: Record, rows: Rows) -> Change:
    """A change that shows as contacts without end."""
    far = np.flatnonzero(record.standardised > RATIO)
    joints = far if len(far) else [record.standardised.argmax()]
    at = float(rows.time[0]) if gate.began is None else gate.began
    return Change(at, tuple(int(joint) for joint in joints), usual, record, "sudden")
