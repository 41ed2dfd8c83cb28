"""Which predicted rows are learnt: contacts are not, nor rows after a change that waits for a decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import AHEAD_S, Rows
from lipcore.online.changes.departure import Departure
from lipcore.online.changes.detectors import RATIO, Change, ChangeDetector, friction_share
from lipcore.online.changes.opening import Opening
from lipcore.online.gates import Patience, is_contact
from lipcore.online.record import Record
from lipcore.online.screening import Screened, Trained
from lipcore.vocabulary import CODES, LEARNT

CONTACT, CHANGE, PAYLOAD, PAUSED = (CODES.index(code) for code in ("contact", "change", "payload", "paused"))
MOST_INNOVATIONS = 1000
"""Rows whose innovations are kept to tell friction from a payload."""


@dataclass(frozen=True)
class JudgeOptions:
    """What the owner of a model has set. enabled: whether rows are learnt; on_change: what follows from a change;
    contact_threshold: standard deviations from which on a row is a contact."""

    enabled: bool = True
    on_change: Literal["hold", "adapt", "learn"] = "hold"
    contact_threshold: float = 8.0


@dataclass(frozen=True)
class ContactGate:
    """Rejects rows far outside a stream's predictive interval for as long as that can be a contact; immutable.

    It stands back while a changed robot is learnt anew. patience: how long rows have been contacts. calm: how long they
    have not, while the gate stands back; else None.
    """

    patience: Patience
    calm: Patience | None = None

    @classmethod
    def start(cls, seconds: float) -> ContactGate:
        """A gate that keeps contacts out for so long."""
        return cls(Patience(seconds))

    def to_json(self) -> list[list[Any] | None]:
        """Its state as numbers and lists; `from_json` gives back the same gate to the last bit."""
        return [None if each is None else list(astuple(each)[1:]) for each in (self.patience, self.calm)]

    @classmethod
    def from_json(cls, values: Sequence[Sequence[Any] | None], seconds: float) -> ContactGate:
        """The gate that `to_json` wrote, with the patience that is set now, s."""
        patience, calm = (None if each is None else Patience(seconds, *each) for each in values)
        return cls(patience or Patience(seconds), calm)

    @property
    def open(self) -> bool:
        """Whether it stands back: contacts and what has changed cannot be told apart."""
        return self.calm is not None

    @property
    def exhausted(self) -> bool:
        """Whether this has lasted too long for a contact."""
        return self.patience.exhausted

    @property
    def began(self) -> float | None:
        """Event time of the first of the rows that have been contacts for so long, s."""
        return None if self.patience.last is None else self.patience.last - self.patience.elapsed

    def step(self, time: Array, contact: NDArray[np.bool_]) -> ContactGate:
        """Follow rows at event times (N,) that are contacts or not; a gate that stood back returns once they fit."""
        if self.calm is None:
            return ContactGate(self.patience.step(time, contact))
        calm = self.calm.step(time, ~contact)
        return ContactGate.start(calm.seconds) if calm.exhausted else ContactGate(self.patience, calm)

    def stand_back(self) -> ContactGate:
        """Let everything pass until most rows fit again for as long as the patience lasts."""
        fresh = Patience(self.patience.seconds)
        return ContactGate(fresh, fresh)


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
    """State of judging after the rows before: the stream's gate, the model's detector, innovations and departure from
    what it was trained on, and the stream's opening, None where that has been judged; immutable."""

    gate: ContactGate
    detector: ChangeDetector
    innovations: Innovations
    departure: Departure | None = None
    opening: Opening | None = None


@dataclass(frozen=True)
class Verdict:
    """rows: with their final codes. record: of those that count for quality. watch: for the next rows.

    surprise: mean of e²/s² of the same rows, (n,), with s less the floor of past errors, which would
    hide a change from the detector.

    change: detected with these rows; while learning waits already, how a stream began is all that is. held: whether
    these rows had to wait for a decision. departed, opened: what shows the change where that is the distance from the
    version as trained, or how the stream began.
    """

    rows: Rows
    record: Record | None
    surprise: Array | None
    watch: Watch
    change: Change | None
    held: bool
    departed: Departure | None = None
    opened: Opening | None = None

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """Evidence of the change, for JSON."""
        assert self.change is not None
        evidence = self.change.evidence(joint_names, self.watch.innovations.friction(self.change.at))
        reason = self.departed or self.opened
        return evidence if reason is None else evidence | reason.evidence(joint_names)


def judge(
    batch: Screened,
    watch: Watch,
    held: bool,
    options: JudgeOptions,
    usual: Callable[[], Record],
    received: float = np.inf,
    carried: float | None = None,
    scale: Array | float = 1.0,
) -> Verdict:
    """Decide about the rows that were predicted. held: whether learning waits already; usual: the record of before;
    received: when the rows came, Unix time, s; carried: event time, s, from which on the arm carries something, None
    where it does not: such rows teach what it carries, and not the arm; scale: of the version's intervals, (n,)."""
    rows = batch.rows.take(batch.predicted)
    if not len(rows):
        return Verdict(batch.rows, None, None, watch, None, held)
    contact = is_contact(rows.tau, batch.mean, batch.std, batch.noise_std, options.contact_threshold)
    gate = watch.gate if held else watch.gate.step(rows.time, contact)
    passing = held or watch.gate.open or gate.exhausted
    counted = np.ones(len(rows), np.bool_) if passing else ~contact
    detector, change, record, surprise = watch.detector, None, None, None
    departure, departed = watch.departure, None
    opening, opened, waiting = watch.opening, None, held
    if opening is not None:
        opening = _begun(opening, batch, rows, carried, scale)
        opened, opening = (opening if opening.misfit else None), (None if opening.over else opening)
    if counted.any():
        error, bare = (rows.tau - batch.mean)[counted], batch.bare[counted]
        answered = batch.answered or batch
        record = Record.of(rows.tau[counted], answered.mean[counted], answered.std[counted], batch.noise_std)
        surprise = (error**2 / (bare**2 + batch.noise_std**2)).mean(axis=0)
        at = min(float(rows.time.max()), received + AHEAD_S)  # one stream's clock is not that of all
        detector, change = detector.step(replace(record, standardised=surprise), at)
        if not held and not watch.gate.open and batch.trained is not None:
            departure = _followed(departure, batch.trained, rows, counted, batch.noise_std)
    if opened is not None and opened.since is not None and not watch.gate.open:
        change = Change(opened.since, opened.joints, usual(), _everything(batch, rows), "sudden")
    elif held or watch.gate.open:
        change = None  # the consequence of a change that is known
    elif change is None and gate.exhausted:
        change = _lasting(gate, _everything(batch, rows), usual(), rows)
    elif change is None and departure is not None and departure.joints:
        departed = departure
        change = Change(departure.began, departure.joints, usual(), _everything(batch, rows), "departure")
    followed = change is not None and not waiting and not (opened is not None and options.on_change == "learn")
    if change is not None and options.on_change == "hold":
        held = True
    elif followed and departed is None:
        gate = gate.stand_back()  # after a departure it does not, as what is learnt is followed too well
    if departure is not None and followed and not held:
        departure = departure.decided()
    if not held and not gate.open:
        detector = detector.acknowledged()
    codes = batch.rows.code.copy()
    learnt = np.where(contact & (not (passing or gate.open)), CONTACT, LEARNT)
    if carried is not None:
        learnt = np.where((learnt == LEARNT) & (rows.time >= carried), PAYLOAD, learnt)
    if not options.enabled:
        learnt = np.where(learnt == LEARNT, PAUSED, learnt)
    codes[batch.predicted] = CHANGE if held else learnt
    judged = replace(batch.rows, code=codes)
    following = Watch(gate, detector, watch.innovations.then(rows, batch.mean), departure, opening)
    return Verdict(judged, record, surprise, following, change, held, departed, opened if change is not None else None)


def _begun(opening: Opening, batch: Screened, rows: Rows, carried: float | None, scale: Array | float) -> Opening:
    """A stream's opening after rows; those that carry what was noticed with them were predicted without it."""
    own = np.full(len(rows), True) if carried is None or batch.trained is None else rows.time < carried
    spread = scale * np.sqrt(batch.bare**2 + batch.noise_std**2)
    return opening.step(rows.time[own], rows.weight[own], (rows.tau - batch.mean)[own], spread[own])


def _everything(batch: Screened, rows: Rows) -> Record:
    """Record of the rows that were predicted, contacts too: what a change is shown with."""
    return Record.of(rows.tau, batch.mean, batch.std, batch.noise_std)


def _followed(
    before: Departure | None, trained: Trained, rows: Rows, counted: NDArray[np.bool_], noise_std: Array
) -> Departure:
    """The departure from a version as trained after rows, (P,), those of them that count: (P,)."""
    if before is None or before.version != trained.version:
        before = Departure.start(trained.version, rows.tau.shape[1])
    kept = counted[trained.rows]
    compared = rows.take(trained.rows[kept])
    error, std = compared.tau - trained.mean[kept], trained.std[kept]
    return before.step(compared.time, trained.share * compared.weight, error, std, noise_std)


def _lasting(gate: ContactGate, record: Record, usual: Record, rows: Rows) -> Change:
    """A change that shows as contacts without end."""
    far = np.flatnonzero(record.standardised > RATIO)
    joints = far if len(far) else [record.standardised.argmax()]
    at = float(rows.time[0]) if gate.began is None else gate.began
    return Change(at, tuple(int(joint) for joint in joints), usual, record, "sudden")
