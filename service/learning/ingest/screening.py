"""The rows of a batch as they go into the log: timed, checked one by one, and predicted before they are learnt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from lipcore.data import independence
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.online.gates import Limits, check_rows
from lipcore.vocabulary import CODES, LEARNT
from service.foundation.settings import Settings
from service.learning.ingest import derivation
from service.learning.ingest.clock import Clock, span
from service.learning.ingest.derivation import EDGE
from service.learning.ingest.parsing import Measured
from service.learning.learning_options import LearningOptions
from service.learning.schema import DerivedAcceleration

NON_FINITE, LIMIT, TIME_JUMP = (CODES.index(code) for code in ("non_finite", "limit", "time_jump"))


@dataclass(frozen=True)
class Timed:
    """Rows with event times and the codes of `check_rows`. offset: of the stream, s; span: see `clock.span`."""

    rows: Rows
    offset: float
    span: list[float] | None


@dataclass(frozen=True)
class Screened:
    """Rows and what the model that serves said of those that passed so far.

    own: which of the rows came in this batch, the others had waited for it. predicted: (N,); mean, std, bare: (P, n) of
    these, bare the standard deviation without the floor that past errors put under `std`. noise_std: (n,).
    """

    rows: Rows
    own: slice
    derived: DerivedAcceleration | None
    predicted: NDArray[np.bool_]
    mean: Array
    std: Array
    bare: Array
    noise_std: Array

    @property
    def until(self) -> float | None:
        """Latest event time of the rows that were predicted, s; None where there are none."""
        return float(self.rows.time[self.predicted].max()) if self.predicted.any() else None


def limits(model: TorqueModel, options: LearningOptions, settings: Settings) -> Limits:
    """What a row of a model may hold: its actuators' limits are those of its options, else those of its URDF."""
    torque = None if options.torque_limits is None else np.array(options.torque_limits)
    if torque is None and model.robot is not None:
        effort = np.asarray(model.robot.model.effortLimit, np.float64)[list(model.robot.order)]
        if (effort > 0).all():
            torque = effort
    return Limits(
        settings.max_position,
        settings.max_velocity,
        settings.max_acceleration,
        torque,
        settings.max_time_gap_s,
        settings.stationary_speed,
    )


def timed(measured: Measured, clock: Clock, bounds: Limits, previous: float | None) -> Timed:
    """Check rows one by one, date and weigh them. previous: event time of the row right before them, s, where known.

    Weights come from the batch itself where it has a spacing, so that they do not depend on the order of arrival.
    """
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
    weights = (
        independence.stream_weights(time, previous) if t is None or len(measured) == 1 else independence.even_weights(t)
    )
    rows = Rows(time, measured.q, measured.dq, ddq, measured.tau, codes, weights)
    return Timed(rows, offset, span(t, codes))


def derive(
    session: Session, model: str, stream_id: str, sequence: int, rows: Rows, t: Array, bounds: Limits
) -> tuple[Rows, slice, DerivedAcceleration]:
    """Derive the accelerations of a batch: its rows and those of its neighbours that it completes, and which are own.

    t: (N,) by the stream's own clock, s.
    Raise InvalidRequestError where they cannot be derived.
    """
    found = derivation.complete(session, model, stream_id, sequence, rows, t)
    everything = found.rows
    codes = everything.code.copy()
    unknown = ~np.isfinite(everything.ddq).all(axis=1)
    codes[unknown & (codes == LEARNT)] = EDGE
    codes[found.decided] = LEARNT
    fresh = codes == LEARNT
    again = everything.take(fresh)
    codes[fresh] = check_rows(None, again.q, again.dq, again.ddq, again.tau, bounds)
    chosen = found.decided.copy()
    chosen[found.own] = True
    first = int(found.decided[: found.own.start].sum())
    said = DerivedAcceleration(
        delay_s=found.delay_s, window=found.window, rate_hz=found.rate, carried=int(found.decided.sum())
    )
    checked = replace(everything, code=codes)
    return checked.take(chosen), slice(first, first + len(rows)), said


def predict(rows: Rows, own: slice, derived: DerivedAcceleration | None, model: TorqueModel) -> Screened:
    """Let a model predict the rows that passed; those it has no finite answer for are beyond its limits."""
    good = rows.take(rows.code == LEARNT)
    mean, bare = _answers(good, model)
    std = np.sqrt(np.maximum(bare**2, model.posterior.floor.numpy()))
    return _screened(rows, own, derived, mean, std, bare, model)


def answered(rows: Rows, mean: Array, std: Array, model: TorqueModel) -> Screened:
    """Rows that a model has answered when they came: mean, std (N, n)."""
    good = rows.code == LEARNT
    mean, std = mean[good], std[good]
    bare = _answers(rows.take(good), model)[1] if model.posterior.floor.any() else std
    return _screened(rows, slice(0, len(rows)), None, mean, std, bare, model)


def _answers(rows: Rows, model: TorqueModel) -> tuple[Array, Array]:
    """Mean and standard deviation, without floor, of rows that are finite: (N, n) each."""
    evaluator = model.evaluator.revised(model.evaluator.packed, np.zeros(model.n_joints))
    mean, std, _ = evaluator.many(rows.q, rows.dq, rows.ddq)
    return mean, std


def _screened(
    rows: Rows,
    own: slice,
    derived: DerivedAcceleration | None,
    mean: Array,
    std: Array,
    bare: Array,
    model: TorqueModel,
) -> Screened:
    codes, predicted = rows.code.copy(), rows.code == LEARNT
    known = np.isfinite(mean).all(axis=1) & np.isfinite(std).all(axis=1)
    codes[predicted] = np.where(known, LEARNT, LIMIT)
    predicted[predicted] = known
    checked = replace(rows, code=codes)
    return Screened(checked, own, derived, predicted, mean[known], std[known], bare[known], model.noise_std)
