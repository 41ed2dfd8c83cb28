"""Decide which predicted rows are learnt: contacts are rejected, and all rows while a change awaits a decision."""

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
from lipcore.online.scale import IntervalCoverage, ScaleRecord
from lipcore.online.screening import BasePrediction, PredictedBatch
from lipcore.online.stream import StreamRecord
from lipcore.vocabulary import Code

ACCEPTED_CODES = (Code.LEARNT, Code.STATIONARY, Code.PAYLOAD)
"""Codes of rows that were not rejected. The model, with the payload it knows of, must explain them."""


@dataclass(frozen=True)
class JudgeOptions:
    """Options that a user has set for a model."""

    enabled: bool = True
    """Whether rows are learnt."""
    on_change: Literal["hold", "adapt", "learn"] = "hold"
    """Reaction to a change of the robot: pause learning, adapt to it, or continue."""
    contact_threshold: float = 8.0
    """Min standard deviations of a contact."""
    adaptive_intervals: bool = True
    """Whether streams scale their intervals."""


@dataclass(frozen=True)
class Judgement:
    """The decision about a batch, and the records after it."""

    rows: Rows
    """The rows with their final codes."""
    record: Record | None
    """Record of the rows that count for quality; None if there are none."""
    logged: LoggedJudgement
    """What the log stores besides `rows` and `record`."""
    stream: StreamRecord
    """Record of the stream after the batch."""
    model: ModelRecord
    """Record of the model after the batch."""
    change: Change | None = None
    """The change that these rows show."""
    departed: Departure | None = None
    """The departure from the version as trained, if it is the cause of the change."""
    opened: Opening | None = None
    """The first second of the stream, if it is the cause of the change."""

    def evidence(self, joint_names: Sequence[str]) -> dict[str, Any]:
        """Return the evidence of the change for JSON."""
        assert self.change is not None
        evidence = self.change.evidence(joint_names, self.model.innovations.friction(self.change.at))
        reason = self.departed or self.opened
        return evidence if reason is None else evidence | reason.evidence(joint_names)


@dataclass(frozen=True)
class GateResult:
    """The P predicted rows after the contact gate."""

    rows: Rows
    contact: NDArray[np.bool_]
    gate: ContactGate
    """The gate after these rows."""
    passing: bool
    """Whether contacts are let through."""
    counted: NDArray[np.bool_]
    """Rows that count for quality, (P,)."""


@dataclass(frozen=True)
class ChangeFindings:
    """What the rows of a batch show about the robot. `model` and `opening` are the records after them."""

    model: ModelRecord
    opening: Opening | None
    record: Record | None = None
    surprise: Array | None = None
    """Mean of e²/s² of the counted rows, (n,). s excludes the floor of past errors, which would hide a change from the
    detector."""
    change: Change | None = None
    departed: Departure | None = None
    opened: Opening | None = None


def judge(
    batch: PredictedBatch,
    stream: StreamRecord,
    model: ModelRecord,
    options: JudgeOptions,
    usual: Callable[[], Record],
    received: float,
    carried: float | None = None,
) -> Judgement:
    """Decide about the predicted rows of a batch.

    stream, model: the records before the batch. usual: returns the record of the time before. received: when the rows
    arrived, Unix time, s. carried: event time, s, since when the arm carries a payload, None if it carries none. Rows
    since then are used to estimate the payload, not the arm.
    """
    gated = gate_rows(batch, stream.gate, model.held, options)
    found = find_change(batch, gated, stream, model, usual, received, carried)
    opened_in_vain = found.opened is not None and options.on_change == "learn"
    followed = found.change is not None and not model.held and not opened_in_vain
    held = model.held or (found.change is not None and options.on_change == "hold")
    gate, departure = gated.gate, found.model.departure
    if followed and not held:
        if found.departed is None:
            gate = gate.let_all_pass()  # after a departure errors are small: the gate stays closed
        departure = departure and departure.decided()
    rows = _assign_codes(batch, gated, gate, held, options, carried)
    doubted = held and (found.opened is not None or stream.doubted)
    scale, answered = _follow_scale(batch, rows, stream.scale, options)
    logged = LoggedJudgement(
        held=held,
        waited=model.held,
        open=gate.is_open,
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


def gate_rows(batch: PredictedBatch, gate: ContactGate, waiting: bool, options: JudgeOptions) -> GateResult:
    """Separate contacts from rows that fit. waiting: whether a change paused learning, which stops the gate, too."""
    rows = batch.rows.take(batch.predicted)
    contact = is_contact(rows.tau, batch.mean, batch.std, batch.noise_std, options.contact_threshold)
    after = gate if waiting else gate.step(rows.time, contact)
    passing = waiting or gate.is_open or after.exhausted
    return GateResult(rows, contact, after, passing, np.ones(len(rows), np.bool_) if passing else ~contact)


def find_change(
    batch: PredictedBatch,
    gated: GateResult,
    stream: StreamRecord,
    model: ModelRecord,
    usual: Callable[[], Record],
    received: float,
    carried: float | None,
) -> ChangeFindings:
    """Return the change of the robot that the rows show, if any.

    The causes are checked in this order: the stream's first second, contacts that do not end, errors that have grown,
    and departure from the version as trained.
    """
    rows, counted, opening = gated.rows, gated.counted, stream.opening
    if not len(rows):
        return ChangeFindings(model, opening)
    opened: Opening | None = None
    if opening is not None:
        opening = _extend_opening(opening, batch, rows, carried)
        opened, opening = (opening if opening.is_misfit else None), (None if opening.is_complete else opening)
    record, surprise, change, departed, following = None, None, None, None, model
    known = model.held or stream.gate.is_open  # consequences of a known change are not another change
    if counted.any():
        error, bare = (rows.tau - batch.mean)[counted], batch.bare[counted]
        answered = batch.stream_answers or batch
        record = Record.of(rows.tau[counted], answered.mean[counted], answered.std[counted], batch.noise_std)
        surprise = (error**2 / (bare**2 + batch.noise_std**2)).mean(axis=0)
        following, change = model.step(record, surprise, min(float(rows.time.max()), received + AHEAD_S))
        if not known and batch.trained is not None:
            compared = _follow_departure(model.departure, batch, batch.trained, rows, counted)
            following = replace(following, departure=compared)
    departure = following.departure
    if opened is not None and opened.since is not None and not stream.gate.is_open:
        change = Change(opened.since, opened.joints, usual(), _record_predicted(batch, rows), "sudden")
    elif known:
        change = None
    elif change is None and gated.gate.exhausted:
        change = _make_lasting_change(gated.gate, _record_predicted(batch, rows), usual(), rows)
    elif change is None and departure is not None and departure.joints:
        departed = departure
        change = Change(departure.began, departure.joints, usual(), _record_predicted(batch, rows), "departure")
    following = replace(following, innovations=model.innovations.append(rows, batch.mean))
    return ChangeFindings(
        following, opening, record, surprise, change, departed, opened if change is not None else None
    )


def _assign_codes(
    batch: PredictedBatch,
    gated: GateResult,
    gate: ContactGate,
    held: bool,
    options: JudgeOptions,
    carried: float | None,
) -> Rows:
    """Return the rows of a batch with their final codes. gate: after the decision about a change."""
    learnt = np.where(gated.contact & (not (gated.passing or gate.is_open)), Code.CONTACT, Code.LEARNT)
    if carried is not None:
        learnt = np.where((learnt == Code.LEARNT) & (gated.rows.time >= carried), Code.PAYLOAD, learnt)
    if not options.enabled:
        learnt = np.where(learnt == Code.LEARNT, Code.PAUSED, learnt)
    codes = batch.rows.code.copy()
    codes[batch.predicted] = Code.CHANGE if held else learnt
    return replace(batch.rows, code=codes)


def _follow_scale(
    batch: PredictedBatch, rows: Rows, known: ScaleRecord | None, options: JudgeOptions
) -> tuple[ScaleRecord | None, IntervalCoverage | None]:
    """Return the scale of a stream's intervals after a batch, and their coverage; None if intervals do not adapt.

    Another version starts from its own scale.
    """
    if not options.adaptive_intervals or batch.interval_scores is None:
        return None, None
    if known is None or known.version != batch.version:
        known = ScaleRecord.start(batch.scale, batch.version)
    held = IntervalCoverage.of(known.state, batch.interval_scores)
    # errors of predictions with another payload say nothing about the scale
    if batch.stream_answers is None:
        known = known.step(batch.interval_scores, np.isin(rows.code[batch.answerable], ACCEPTED_CODES))
    return known, held


def _extend_opening(opening: Opening, batch: PredictedBatch, rows: Rows, carried: float | None) -> Opening:
    """Return a stream's opening after these rows, without those of a payload that was noticed in this batch.

    Such rows were predicted without the payload.
    """
    own = np.full(len(rows), True) if carried is None or batch.trained is None else rows.time < carried
    spread = batch.scale * np.sqrt(batch.bare**2 + batch.noise_std**2)
    return opening.step(rows.time[own], rows.weight[own], (rows.tau - batch.mean)[own], spread[own])


def _record_predicted(batch: PredictedBatch, rows: Rows) -> Record:
    """Return the record of all predicted rows, contacts included: the evidence of a change."""
    return Record.of(rows.tau, batch.mean, batch.std, batch.noise_std)


def _follow_departure(
    before: Departure | None, batch: PredictedBatch, trained: BasePrediction, rows: Rows, counted: NDArray[np.bool_]
) -> Departure:
    """Return the departure from a version as trained after P rows. counted: (P,)."""
    if before is None or before.version != batch.version:
        before = Departure.start(batch.version, rows.tau.shape[1])
    kept = counted[trained.rows]
    compared = rows.take(trained.rows[kept])
    error, std = compared.tau - trained.mean[kept], trained.std[kept]
    return before.step(compared.time, trained.share * compared.weight, error, std, batch.noise_std)


def _make_lasting_change(gate: ContactGate, record: Record, usual: Record, rows: Rows) -> Change:
    """Return a change that shows as contacts that do not end."""
    far = np.flatnonzero(record.standardised > OPTIONS.ratio)
    joints = far if len(far) else [record.standardised.argmax()]
    at = float(rows.time[0]) if gate.began is None else gate.began
    return Change(at, tuple(int(joint) for joint in joints), usual, record, "sudden")
