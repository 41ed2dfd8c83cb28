"""Which predicted rows are learnt: contacts are not, nor rows after a change that waits for a decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.online.batch import AHEAD_S, Rows
from lipcore.online.changes.departure import Departure
from lipcore.online.changes.detectors import OPTIONS, Change
from lipcore.online.changes.opening import Opening
from lipcore.online.gates import ContactGate, is_contact
from lipcore.online.judgement import LoggedJudgement, ModelRecord
from lipcore.online.record import Record
from lipcore.online.scale import HeldIntervals, ScaleRecord
from lipcore.online.screening import Screened, Trained
from lipcore.online.stream import StreamRecord
from lipcore.vocabulary import Code

ACCEPTED = (Code.LEARNT, Code.STATIONARY, Code.PAYLOAD)
"""Codes of rows that are not kept out: the model, with the payload it knows of, is to explain them."""


@dataclass(frozen=True)
class JudgeOptions:
    """What the owner of a model has set.

    enabled: whether rows are learnt; on_change: what follows from a change; contact_threshold: standard deviations from
    which on a row is a contact; adaptive_intervals: whether streams have a scale.
    """

    enabled: bool = True
    on_change: Literal["hold", "adapt", "learn"] = "hold"
    contact_threshold: float = 8.0
    adaptive_intervals: bool = True


@dataclass(frozen=True)
class Judgement:
    """What becomes of a batch.

    rows: with their final codes. record: of those that count for quality, None without any. logged: what the log keeps
    beside both. stream, model: what is known after the batch. change: detected with these rows; departed, opened: what
    shows it, if that is the distance from the version as trained, or how the stream began.
    """

    rows: Rows
    record: Record | None
    logged: LoggedJudgement
    stream: StreamRecord
    model: ModelRecord
    change: Change | None = None
    departed: Departure | None = None
    opened: Opening | None = None

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """Evidence of the change, for JSON."""
        assert self.change is not None
        evidence = self.change.evidence(joint_names, self.model.innovations.friction(self.change.at))
        reason = self.departed or self.opened
        return evidence if reason is None else evidence | reason.evidence(joint_names)


@dataclass(frozen=True)
class Gated:
    """The P rows that were predicted, after the gate of contacts. gate: after them; passing: whether contacts are let
    through; counted: rows that count for quality, (P,)."""

    rows: Rows
    contact: NDArray[np.bool_]
    gate: ContactGate
    passing: bool
    counted: NDArray[np.bool_]


@dataclass(frozen=True)
class Found:
    """What the rows of a batch say of the robot. model, opening: after them; surprise: mean of e²/s² of the rows that
    count, (n,), with s less the floor of past errors, which would hide a change from the detector."""

    model: ModelRecord
    opening: Opening | None
    record: Record | None = None
    surprise: Array | None = None
    change: Change | None = None
    departed: Departure | None = None
    opened: Opening | None = None


def judge(
    batch: Screened,
    stream: StreamRecord,
    model: ModelRecord,
    options: JudgeOptions,
    usual: Callable[[], Record],
    received: float,
    carried: float | None = None,
) -> Judgement:
    """Decide about the rows of a batch that were predicted.

    stream, model: what is known before it. usual: returns the record of the time before. received: when the rows came,
    Unix time, s. carried: event time, s, from which on the arm carries something, None if it does not: such rows teach
    what it carries, and not the arm.
    """
    gated = gate_rows(batch, stream.gate, model.held, options)
    found = find_change(batch, gated, stream, model, usual, received, carried)
    opened_in_vain = found.opened is not None and options.on_change == "learn"
    followed = found.change is not None and not model.held and not opened_in_vain
    held = model.held or (found.change is not None and options.on_change == "hold")
    gate, departure = gated.gate, found.model.departure
    if followed and not held:
        if found.departed is None:
            gate = gate.stand_back()  # after a departure it does not, as what is learnt is followed too well
        departure = departure and departure.decided()
    rows = _coded(batch, gated, gate, held, options, carried)
    doubted = held and (found.opened is not None or stream.doubted)
    scale, answered = _scaled(batch, rows, stream.scale, options)
    logged = LoggedJudgement(
        held=held,
        waited=model.held,
        open=gate.open,
        doubted=doubted,
        aside=held or not options.enabled,
        until=None if batch.until is None else min(batch.until, received + AHEAD_S),
        departure=departure,
        surprise=found.surprise,
        answered=answered,
        accepted_scale=None if scale is None else scale.accepted,
    )
    return Judgement(
        rows,
        found.record,
        logged,
        replace(stream, gate=gate, opening=found.opening, doubted=doubted, scale=scale, received=received),
        found.model.settled(logged),
        found.change,
        found.departed,
        found.opened,
    )


def gate_rows(batch: Screened, gate: ContactGate, waiting: bool, options: JudgeOptions) -> Gated:
    """Tell contacts from rows that fit. waiting: whether learning waits for a decision, and the gate with it."""
    rows = batch.rows.take(batch.predicted)
    contact = is_contact(rows.tau, batch.mean, batch.std, batch.noise_std, options.contact_threshold)
    after = gate if waiting else gate.step(rows.time, contact)
    passing = waiting or gate.open or after.exhausted
    return Gated(rows, contact, after, passing, np.ones(len(rows), np.bool_) if passing else ~contact)


def find_change(
    batch: Screened,
    gated: Gated,
    stream: StreamRecord,
    model: ModelRecord,
    usual: Callable[[], Record],
    received: float,
    carried: float | None,
) -> Found:
    """Look for a change of the robot: by how the stream began, by contacts without end, by errors that have grown, by
    the distance from the version as trained, in this order."""
    rows, counted, opening = gated.rows, gated.counted, stream.opening
    if not len(rows):
        return Found(model, opening)
    opened: Opening | None = None
    if opening is not None:
        opening = _begun(opening, batch, rows, carried)
        opened, opening = (opening if opening.misfit else None), (None if opening.over else opening)
    record, surprise, change, departed, following = None, None, None, None, model
    known = model.held or stream.gate.open  # a change is known of: what follows from it is none of its own
    if counted.any():
        error, bare = (rows.tau - batch.mean)[counted], batch.bare[counted]
        answered = batch.answered or batch
        record = Record.of(rows.tau[counted], answered.mean[counted], answered.std[counted], batch.noise_std)
        surprise = (error**2 / (bare**2 + batch.noise_std**2)).mean(axis=0)
        following, change = model.step(record, surprise, min(float(rows.time.max()), received + AHEAD_S))
        if not known and batch.trained is not None:
            compared = _compared(model.departure, batch, batch.trained, rows, counted)
            following = replace(following, departure=compared)
    departure = following.departure
    if opened is not None and opened.since is not None and not stream.gate.open:
        change = Change(opened.since, opened.joints, usual(), _everything(batch, rows), "sudden")
    elif known:
        change = None
    elif change is None and gated.gate.exhausted:
        change = _lasting(gated.gate, _everything(batch, rows), usual(), rows)
    elif change is None and departure is not None and departure.joints:
        departed = departure
        change = Change(departure.began, departure.joints, usual(), _everything(batch, rows), "departure")
    following = replace(following, innovations=model.innovations.then(rows, batch.mean))
    return Found(following, opening, record, surprise, change, departed, opened if change is not None else None)


def _coded(
    batch: Screened, gated: Gated, gate: ContactGate, held: bool, options: JudgeOptions, carried: float | None
) -> Rows:
    """The rows of a batch with their final codes. gate: once a change was decided about."""
    learnt = np.where(gated.contact & (not (gated.passing or gate.open)), Code.CONTACT, Code.LEARNT)
    if carried is not None:
        learnt = np.where((learnt == Code.LEARNT) & (gated.rows.time >= carried), Code.PAYLOAD, learnt)
    if not options.enabled:
        learnt = np.where(learnt == Code.LEARNT, Code.PAUSED, learnt)
    codes = batch.rows.code.copy()
    codes[batch.predicted] = Code.CHANGE if held else learnt
    return replace(batch.rows, code=codes)


def _scaled(
    batch: Screened, rows: Rows, known: ScaleRecord | None, options: JudgeOptions
) -> tuple[ScaleRecord | None, HeldIntervals | None]:
    """The scale of a stream's intervals after a batch, and what its intervals held; None if they do not adapt. Another
    version begins anew, from its own scale."""
    if not options.adaptive_intervals or batch.seen is None:
        return None, None
    if known is None or known.version != batch.version:
        known = ScaleRecord.start(batch.scale, batch.version)
    held = HeldIntervals.of(known.state, batch.seen)
    # other errors were of the arm without what it carries, or with what it no longer does
    if batch.answered is None:
        known = known.step(batch.seen, np.isin(rows.code[batch.asked], ACCEPTED))
    return known, held


def _begun(opening: Opening, batch: Screened, rows: Rows, carried: float | None) -> Opening:
    """A stream's opening after rows; those that carry what was noticed with them were predicted without it."""
    own = np.full(len(rows), True) if carried is None or batch.trained is None else rows.time < carried
    spread = batch.scale * np.sqrt(batch.bare**2 + batch.noise_std**2)
    return opening.step(rows.time[own], rows.weight[own], (rows.tau - batch.mean)[own], spread[own])


def _everything(batch: Screened, rows: Rows) -> Record:
    """Record of the rows that were predicted, contacts too: what a change is shown with."""
    return Record.of(rows.tau, batch.mean, batch.std, batch.noise_std)


def _compared(
    before: Departure | None, batch: Screened, trained: Trained, rows: Rows, counted: NDArray[np.bool_]
) -> Departure:
    """The departure from a version as trained after rows, (P,), those of them that count: (P,)."""
    if before is None or before.version != batch.version:
        before = Departure.start(batch.version, rows.tau.shape[1])
    kept = counted[trained.rows]
    compared = rows.take(trained.rows[kept])
    error, std = compared.tau - trained.mean[kept], trained.std[kept]
    return before.step(compared.time, trained.share * compared.weight, error, std, batch.noise_std)


def _lasting(gate: ContactGate, record: Record, usual: Record, rows: Rows) -> Change:
    """A change that shows as contacts without end."""
    far = np.flatnonzero(record.standardised > OPTIONS.ratio)
    joints = far if len(far) else [record.standardised.argmax()]
    at = float(rows.time[0]) if gate.began is None else gate.began
    return Change(at, tuple(int(joint) for joint in joints), usual, record, "sudden")
