"""The rows of a batch as they go into the log: dated, checked one by one, their accelerations derived where these were
not sent, and predicted before they are learnt.

Rows are dated in event time: Unix time, counted by the stream's own clock. A stream's offset is fixed once, so that the
last row of its first batch lies at that batch's arrival. It is 0 where no batch of the stream has had times yet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online import acceleration
from lipcore.online.acceleration import JITTER, RateError
from lipcore.online.adaptive import scores
from lipcore.online.batch import Rows
from lipcore.online.gates import RowLimits, check_rows, time_span
from lipcore.vocabulary import CODES, LEARNT
from lipserve.wording import percent
from service.foundation.errors import invalid_request
from service.foundation.settings import Settings
from service.journal import log
from service.learning.schema import DerivedAcceleration, LearningOptions
from service.models.served import Served
from service.storage.database import EventRow, StreamRow

NON_FINITE, LIMIT, TIME_JUMP, EDGE, STATIONARY = (
    CODES.index(code) for code in ("non_finite", "limit", "time_jump", "edge", "stationary")
)

COMPARED, LEAST_COMPARED = 4.0, 10
"""Rows that are compared with the version as trained, for each effective row, and of a batch at least: neighbours of a
fast stream say the same, and each prediction takes time of a core."""
FAR_AHEAD = 86400.0
"""How far ahead of its arrival a row may be dated, s: as long a recording may be sent in one go."""


@dataclass(frozen=True)
class Measured:
    """N rows as measured, in the model's joint order. t: (N,) by the stream's clock, s; the others (N, n), SI."""

    t: Array | None
    q: Array
    dq: Array
    ddq: Array | None
    tau: Array

    def __len__(self) -> int:
        return len(self.q)


@dataclass(frozen=True)
class StreamTime:
    """What is known of a stream's time when a batch arrives.

    offset: s, None while it is unknown. after, before: times, by the stream's clock, that the rows must lie between.
    adjacent: whether `after` is the time of the row right before the batch. arrived: Unix time, s.
    """

    offset: float | None
    after: float | None
    before: float | None
    adjacent: bool
    arrived: float

    @staticmethod
    def of(
        source: StreamRow | None, sequence: int, before: EventRow | None, after: EventRow | None, arrived: float
    ) -> StreamTime:
        """The clock of a stream, with the batches that are kept next below and above a sequence."""
        offset = None if source is None or source.offset == 0 else source.offset
        first, last = _span(after), _span(before)
        latest = None if offset is None else arrived + FAR_AHEAD - offset
        bounds = [bound for bound in (latest, None if first is None else first[0]) if bound is not None]
        adjacent = before is not None and before.last_sequence == sequence - 1
        return StreamTime(offset, None if last is None else last[1], min(bounds, default=None), adjacent, arrived)

    def settled(self, t: Array | None, usable: NDArray[np.bool_], gap: float) -> float:
        """The offset, s, fixed now if these rows (times (N,), those to be believed) are the first that have times."""
        if self.offset is not None:
            return self.offset
        if t is None or not usable.any():
            return 0.0
        times = t[usable]
        runs = np.split(times, np.flatnonzero(np.diff(times) > gap) + 1)
        # one wrong time at the end, far from all others, must not date them all
        last = next((run for run in reversed(runs) if len(run) > 1), runs[-1])
        return self.arrived - float(last[-1])

    def leaps(self, t: Array, usable: NDArray[np.bool_], offset: float, gap: float) -> NDArray[np.bool_]:
        """Rows (N,) dated later than now, right after a gap, and before another one or at the end: most likely wrong.
        Taken for true, such a time would be the present for all rows to come."""
        leaping = np.zeros(len(t), dtype=np.bool_)
        times = t[usable]
        start = self.after if self.adjacent and self.after is not None else times[:1]
        after_gap = np.diff(times, prepend=start) > gap
        alone = after_gap & np.append(after_gap[1:], True)
        leaping[usable] = alone[: len(times)] & (times + offset > self.arrived + gap)
        return leaping

    def event_time(self, t: Array | None, offset: float, rows: int) -> Array:
        """Event times (N,), s, finite: a row without a time has that of the row before it."""
        if t is None:
            return np.full(rows, self.arrived)
        known = np.isfinite(t)
        place = np.maximum.accumulate(np.where(known, np.arange(rows), 0))
        times = t[place] + offset
        return np.where(np.isfinite(times), times, self.arrived)


def span(t: Array | None, codes: NDArray[np.uint8]) -> list[float] | None:
    """First and last time of a batch, by its stream's clock, that its neighbours lie before and after."""
    times = None if t is None else time_span(t, codes)
    return None if times is None else list(times)


def _span(event: EventRow | None) -> list[float] | None:
    times: list[float] | None = None if event is None or event.report is None else event.report["span"]
    return times


@dataclass(frozen=True)
class Dated:
    """Rows with event times and the codes of `check_rows`. offset: of the stream, s; span: see `span`."""

    rows: Rows
    offset: float
    span: list[float] | None


@dataclass(frozen=True)
class Trained:
    """What the version as trained, which learns nothing, predicts of some of the P rows that were predicted.

    rows: (M,), their places among these; share: rows that each stands for; mean, std: (M, n).
    """

    version: int
    rows: NDArray[np.int64]
    share: float
    mean: Array
    std: Array


@dataclass(frozen=True)
class Seen:
    """M measurements beside the intervals that the model believes, of rows that were predicted and of rows at rest.

    time: (M,) event time, s; score: (M, n), see `adaptive.scores`; factor: (M, n), on the half width that they were
    answered with, where a stream has answered them.
    """

    time: Array
    score: Array
    factor: Array | None


@dataclass(frozen=True)
class Screened:
    """Rows, and the predictions of the model that serves for those that passed so far.

    own: which of the rows are of this batch, the others had waited for it. asked: (N,), rows with a finite answer, at
    rest or not; predicted: (N,); mean, std, bare: (P, n) of these, bare the standard deviation without the floor that
    past errors put under `std`. noise_std: (n,). trained: see there; None where nothing is compared with it. seen: what
    intervals are judged by. answered: mean and std of the same rows as a stream was answered, where that was with
    another load than the arm carries by what is known now.
    """

    rows: Rows
    own: slice
    derived: DerivedAcceleration | None
    asked: NDArray[np.bool_]
    predicted: NDArray[np.bool_]
    mean: Array
    std: Array
    bare: Array
    noise_std: Array
    trained: Trained | None = None
    seen: Seen | None = None
    answered: tuple[Array, Array] | None = None

    @property
    def until(self) -> float | None:
        """Latest event time of the rows that were predicted, s; None where there are none."""
        return float(self.rows.time[self.predicted].max()) if self.predicted.any() else None


def limits(model: TorqueModel, options: LearningOptions, settings: Settings) -> RowLimits:
    """What a row of a model may hold: its actuators' limits are those of its options, else those of its URDF."""
    torque = None if options.torque_limits is None else np.array(options.torque_limits)
    if torque is None and model.robot is not None:
        effort = np.asarray(model.robot.model.effortLimit, np.float64)[list(model.robot.order)]
        if (effort > 0).all():
            torque = effort
    return RowLimits(
        settings.max_position,
        settings.max_velocity,
        settings.max_acceleration,
        torque,
        settings.max_time_gap_s,
        settings.stationary_speed,
    )


def dated(measured: Measured, clock: StreamTime, bounds: RowLimits, previous: float | None) -> Dated:
    """Check, date and weigh rows. previous: event time of the row right before them, s, where it is known. Weights come
    from the batch itself where it has a spacing, so that they do not depend on the order of arrival."""
    t = measured.t
    numbers = measured.q, measured.dq, measured.ddq, measured.tau
    codes = check_rows(t, *numbers, bounds, clock.after, clock.before)
    usable = ~np.isin(codes, (NON_FINITE, TIME_JUMP))
    gap = np.inf if bounds.max_gap_s is None else bounds.max_gap_s
    offset = clock.settled(t, usable, gap)
    if t is not None:
        codes[clock.leaps(t, usable, offset, gap) & (codes != LIMIT)] = TIME_JUMP
    ddq = np.full_like(measured.q, np.nan) if measured.ddq is None else measured.ddq
    time = clock.event_time(t, offset, len(measured))
    if t is None or len(measured) == 1:
        weights = independence.stream_weights(time, previous)
    else:
        weights = independence.even_weights(t)
    rows = Rows(time, measured.q, measured.dq, ddq, measured.tau, codes, weights)
    return Dated(rows, offset, span(t, codes))


def predict(
    rows: Rows,
    served: Served,
    own: slice,
    derived: DerivedAcceleration | None = None,
    answered: tuple[Array, Array] | None = None,
    factor: Array | None = None,
    carrying: TorqueModel | None = None,
    with_other_load: bool = False,
) -> Screened:
    """Let a version predict the rows that passed, with what it has learnt and as trained; those it has no finite answer
    for are beyond its limits. carrying: the version with what the arm carries, where it does: it is compared with the
    version as trained no more. answered: mean and std, (N, n) each, of all rows, where a stream has answered them
    already, and factor, (N, n), on their widths; with_other_load: whether it had noticed no load, or one that is gone:
    rows are then judged by what is known now."""
    model = served.model if carrying is None else carrying
    codes, predicted = rows.code.copy(), rows.code == LEARNT
    asked = predicted | ((codes == STATIONARY) & np.isfinite(rows.ddq).all(axis=1))
    good, floor = rows.take(asked), model.posterior.floor
    if answered is None or with_other_load:
        mean, bare = _answers(good, model)
        std = np.sqrt(np.maximum(bare**2, floor))
    else:
        mean, std = (values[asked] for values in answered)
        bare = _answers(good, model)[1] if floor.any() else std
    as_answered = (mean, std) if answered is None else (answered[0][asked], answered[1][asked])
    known = np.asarray(np.isfinite(mean).all(axis=1) & np.isfinite(std).all(axis=1))
    score = scores(good.tau[known] - as_answered[0][known], as_answered[1][known], model.noise_std)
    seen = Seen(good.time[known], score, None if factor is None else factor[asked][known])
    answerable = asked.copy()
    answerable[asked] = known
    judged, known = known & predicted[asked], known[predicted[asked]]
    codes[predicted] = np.where(known, LEARNT, LIMIT)
    predicted[predicted] = known
    checked = replace(rows, code=codes)
    believed = mean[judged], std[judged], bare[judged]
    other = (as_answered[0][judged], as_answered[1][judged]) if with_other_load else None
    if carrying is not None:
        return Screened(checked, own, derived, answerable, predicted, *believed, model.noise_std, None, seen, other)
    compared = evenly(good.weight[judged])
    share = judged.sum() / max(1, len(compared))
    if model is served.base:
        as_trained = believed[0][compared], believed[2][compared]
    else:
        as_trained = _answers(good.take(judged).take(compared), served.base)
    trained = Trained(served.version, compared, share, *as_trained)
    return Screened(checked, own, derived, answerable, predicted, *believed, model.noise_std, trained, seen, other)


def evenly(weight: Array) -> NDArray[np.int64]:
    """Places of the rows that are compared, out of rows of these weights, (N,)."""
    count = min(len(weight), max(LEAST_COMPARED, int(np.ceil(COMPARED * weight.sum()))))
    return np.linspace(0, len(weight) - 1, count).round().astype(np.int64)


def _answers(rows: Rows, model: TorqueModel) -> tuple[Array, Array]:
    """Mean and standard deviation, without floor, of rows that are finite: (N, n) each."""
    evaluator = model.evaluator.revised(model.evaluator.packed, np.zeros(model.n_joints))
    mean, std, _ = evaluator.many(rows.q, rows.dq, rows.ddq)
    return mean, std


def derive(
    session: Session, model: str, stream_id: str, sequence: int, rows: Rows, t: Array, bounds: RowLimits
) -> tuple[Rows, slice, DerivedAcceleration]:
    """Derive the accelerations of a batch of rows, across the batches next to it in its stream.

    An acceleration stands on the velocities of `half` rows on either side of its row. At the ends of a batch they are
    those of the batches before and after. A row waits, coded `edge`, until both are there, in whatever order; it is
    decided with the later one, so that it is learnt exactly once, and as if the stream were one batch.

    rows: their `ddq` is not looked at; t: (N,) by the stream's own clock, s. Return the rows with those of other
    batches that they complete, and which are the batch's own. Raise InvalidRequestError where the rows are too slow or
    too uneven for it.
    """
    rate = _rate(t)
    key = session, model, stream_id, sequence
    half = _window(*key) or acceleration.window(rate)
    head, tail = (_around(*key, way, 2 * half) for way in (-1, 1))
    everything = Rows.concatenate([*head, rows, *tail])
    own = np.zeros(len(everything), np.bool_)
    first = sum(map(len, head))
    own[first : first + len(rows)] = True
    everything = replace(everything, ddq=_slopes(everything, half, rate))
    known = np.isfinite(everything.ddq).all(axis=1)
    codes = everything.code.copy()
    # 2 half rows on either side are so few that every window that is complete reaches into the batch: none was before
    decided = known & ~own & (codes == EDGE)
    codes[~known & (codes == LEARNT)] = EDGE
    codes[decided] = LEARNT
    fresh = codes == LEARNT
    again = everything.take(fresh)
    codes[fresh] = check_rows(None, again.q, again.dq, again.ddq, again.tau, bounds)
    before, carried = int(decided[:first].sum()), int(decided.sum())
    summary = DerivedAcceleration(delay_s=half / rate, window=half, rate_hz=rate, carried=carried)
    return replace(everything, code=codes).take(decided | own), slice(before, before + len(rows)), summary


def _rate(t: Array) -> float:
    """Rows a second, in the longest stretch without a gap: event time is too coarse to tell, to 0.2 µs today. Raise
    InvalidRequestError where accelerations cannot be derived at this rate, or time is too uneven."""
    finite = t[np.isfinite(t)]
    if len(finite) < 2:
        raise invalid_request("t", f"{len(finite)} times", "at least 2 rows with times, to derive ddq from dq with")
    steps = np.diff(finite)
    rising = steps[steps > 0]
    step = float(np.median(rising)) if len(rising) else 0.0
    run = max(_runs(t, np.isfinite(t), step), key=len)
    if len(run) < 2 or 2 * np.count_nonzero(_even(steps, step)) < len(steps):
        spread = f"uneven, with steps from {steps.min():.3g} to {steps.max():.3g} s"
        raise invalid_request(
            "t", spread, f"steps that differ by at most {percent(JITTER)}, to derive ddq from dq with"
        )
    rate = (len(run) - 1) / float(t[run[-1]] - t[run[0]])
    try:
        acceleration.window(rate * (1 - 1e-9))  # so that rounding leads to no other answer later
    except RateError:
        expected = f"measured accelerations, or at least {acceleration.MIN_RATE:g} rows a second to derive them from"
        raise invalid_request("ddq", f"missing, with {rate:.3g} rows a second", expected) from None
    return rate


def _runs(t: Array, usable: NDArray[np.bool_], step: float) -> list[NDArray[np.int64]]:
    """Places of rows that follow each other evenly, run after run."""
    joined = usable[:-1] & usable[1:]
    joined[joined] = _even(t[1:][joined] - t[:-1][joined], step)
    return np.split(np.arange(len(t)), np.flatnonzero(~joined) + 1)


def _even(steps: Array, step: float) -> NDArray[np.bool_]:
    return np.asarray((steps > 0) & (np.abs(steps - step) <= JITTER * step))


def _slopes(rows: Rows, half: int, rate: float) -> Array:
    """Accelerations of all rows in the middle of 2·half + 1 even ones, NaN for the others: (N, n)."""
    ddq = np.full_like(rows.dq, np.nan)
    usable = np.isfinite(rows.time) & np.isfinite(rows.dq).all(axis=1)
    for run in _runs(rows.time, usable, 1 / rate):
        if len(run) > 2 * half:
            # a controller samples more evenly than it stamps, and event time is coarse
            slopes = acceleration.derive(np.arange(len(run)) / rate, rows.dq[run], half)
            ddq[run[slopes.first : slopes.first + len(slopes.ddq)]] = slopes.ddq
    return ddq


def _window(session: Session, model: str, stream_id: str, sequence: int) -> int | None:
    """Window of the batches next to this one: a stream has one, however its rate is measured."""
    for other in (sequence - 1, sequence + 1):
        event = _neighbour(session, model, stream_id, other)
        if event is not None and event.report is not None:
            return int(event.report["derived"]["ddq"]["window"])
    return None


def _neighbour(session: Session, model: str, stream_id: str, sequence: int) -> EventRow | None:
    """The batch of a sequence, if its accelerations were derived and it still teaches."""
    event = log.find_batch(session, model, stream_id, sequence)
    if event is None or event.void or event.report is None or event.report["derived"] is None:
        return None
    return event


def _around(session: Session, model: str, stream_id: str, sequence: int, way: int, count: int) -> list[Rows]:
    """Rows next after (way 1) or before (−1) a batch, without a gap of sequences, in order, at most `count`."""
    parts: list[Rows] = []
    while count > 0:
        sequence += way
        event = _neighbour(session, model, stream_id, sequence)
        if event is None:
            break
        first, last = (event.report or {})["own"]  # without those that had waited for it
        part = log.rows_of(event).take(slice(first, last))
        parts.append(part.take(slice(0, count) if way > 0 else slice(max(len(part) - count, 0), None)))
        count -= len(part)
    return parts[::way]
