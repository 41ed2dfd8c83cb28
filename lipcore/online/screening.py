"""Predict the rows of a batch before they are learnt, by the serving version and by that version as trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.adaptive import scores
from lipcore.online.batch import Rows
from lipcore.online.gates import is_implausible
from lipcore.vocabulary import Code

COMPARED_PER_SAMPLE, MIN_COMPARED_ROWS = 4.0, 10
"""Rows compared with the version as trained: this many per effective sample, and at least so many per batch. Neighbours
in a fast stream are redundant, and each prediction takes time of a core."""


class Version(Protocol):
    """A serving version. model: with what it has learnt online; base: as trained; version: its number."""

    @property
    def model(self) -> TorqueModel: ...  # noqa: D102

    @property
    def base(self) -> TorqueModel: ...  # noqa: D102

    @property
    def version(self) -> int: ...  # noqa: D102


@dataclass(frozen=True)
class BasePrediction:
    """Predictions of the version as trained, which learns nothing, for some of the P predicted rows."""

    rows: NDArray[np.int64]
    """Places of the M compared rows among the P rows, (M,)."""
    share: float
    """Number of rows that each of them represents."""
    mean: Array
    """Predicted torque, (M, n) N·m."""
    std: Array
    """Its standard deviation, (M, n) N·m."""


@dataclass(frozen=True)
class IntervalScores:
    """M measurements compared with the model's intervals: predicted rows and rows at rest."""

    time: Array
    """Event time, (M,) s."""
    score: Array
    """Errors over half widths, (M, n), see `adaptive.scores`."""
    factor: Array | None
    """Factor on the half width that the stream's predictions had, (M, n); None if the rows were not predicted
    before."""


@dataclass(frozen=True)
class StreamAnswers:
    """The predictions that a stream returned for N rows."""

    mean: Array
    """Predicted torque, (N, n) N·m."""
    std: Array
    """Its standard deviation, (N, n) N·m."""
    factor: Array | None = None
    """Factor on half the width of its intervals, (N, n)."""
    other_load: bool = False
    """Whether they were made with another payload than the one known now: a pickup or release was detected later. The
    rows are then judged with the payload known now."""

    def take(self, rows: NDArray[np.bool_]) -> StreamAnswers:
        """Return the predictions for the chosen rows, a mask (N,)."""
        factor = None if self.factor is None else self.factor[rows]
        return StreamAnswers(self.mean[rows], self.std[rows], factor, self.other_load)


@dataclass(frozen=True)
class PredictedBatch:
    """The rows of a batch, with the serving version's predictions for those that passed the gates so far."""

    rows: Rows
    own: slice
    """Rows of this batch. The others are of an earlier batch and were waiting for this one."""
    answerable: NDArray[np.bool_]
    """Rows with a finite prediction, at rest or not, (N,)."""
    predicted: NDArray[np.bool_]
    """Rows that passed, P of (N,)."""
    mean: Array
    """Predicted torque, (P, n) N·m."""
    std: Array
    """Its standard deviation, (P, n) N·m."""
    bare: Array
    """`std` without the floor from past errors, (P, n)."""
    noise_std: Array
    """Standard deviation of the noise, (n,) N·m."""
    version: int
    """Number of the serving version."""
    scale: Array
    """Scale of its intervals as trained, (n,)."""
    trained: BasePrediction | None = None
    """Predictions of the version as trained; None if they are not compared."""
    interval_scores: IntervalScores | None = None
    """Measurements from which the coverage is computed."""
    stream_answers: StreamAnswers | None = None
    """Predictions for the P rows, if they were made with another payload."""

    @property
    def until(self) -> float | None:
        """Latest event time of the predicted rows, s; None if there are none."""
        return float(self.rows.time[self.predicted].max()) if self.predicted.any() else None


def predict(
    rows: Rows,
    version: Version,
    own: slice,
    answered: StreamAnswers | None = None,
    carrying: TorqueModel | None = None,
) -> PredictedBatch:
    """Return the predictions of a version for the rows that passed, with what it has learnt and as trained.

    Rows without a finite prediction get the code `limit`, and torques that cannot be measurements `implausible`.
    answered: the predictions for all rows, if a stream has returned them already. carrying: the version with the
    payload, if the arm carries one; it is not compared with the version as trained.
    """
    model = version.model if carrying is None else carrying
    codes, predicted = rows.code.copy(), rows.code == Code.LEARNT
    asked = predicted | ((codes == Code.STATIONARY) & np.isfinite(rows.ddq).all(axis=1))
    good, floor = rows.take(asked), model.posterior.floor
    given = None if answered is None else answered.take(asked)
    if given is None or given.other_load:
        mean, bare = _answers(good, model)
        std = np.sqrt(np.maximum(bare**2, floor))
    else:
        mean, std = given.mean, given.std
        bare = _answers(good, model)[1] if floor.any() else std
    if given is None:
        given = StreamAnswers(mean, std)
    known = np.asarray(np.isfinite(mean).all(axis=1) & np.isfinite(std).all(axis=1))
    invented, gravity = np.zeros_like(known), model.torque_convention == "gravity_included"
    invented[known] = is_implausible(good.tau[known], given.mean[known], model.noise_std, gravity)
    known &= ~invented
    reached = given.take(known)
    score = scores(good.tau[known] - reached.mean, reached.std, model.noise_std)
    seen = IntervalScores(good.time[known], score, reached.factor)
    answerable = asked.copy()
    answerable[asked] = known
    judged, known = known & predicted[asked], known[predicted[asked]]
    codes[predicted] = np.where(known, Code.LEARNT, Code.LIMIT)
    codes[np.flatnonzero(asked)[invented]] = Code.IMPLAUSIBLE
    predicted[predicted] = known
    mean, std, bare = mean[judged], std[judged], bare[judged]
    return PredictedBatch(
        replace(rows, code=codes),
        own,
        answerable,
        predicted,
        mean,
        std,
        bare,
        model.noise_std,
        version.version,
        version.base.scale,
        None if carrying is not None else _as_trained(good.take(judged), version, mean, bare),
        seen,
        given.take(judged) if given.other_load else None,
    )


def _as_trained(rows: Rows, version: Version, mean: Array, bare: Array) -> BasePrediction:
    """Return the predictions of the version as trained for some rows. mean, bare: (P, n), of what it has learnt."""
    compared = choose_compared(rows.weight)
    same = version.model is version.base
    answers = (mean[compared], bare[compared]) if same else _answers(rows.take(compared), version.base)
    return BasePrediction(compared, len(rows) / max(1, len(compared)), *answers)


def choose_compared(weight: Array) -> NDArray[np.int64]:
    """Return the places of the rows to compare. weight: (N,), of all rows."""
    count = max(MIN_COMPARED_ROWS, int(np.ceil(COMPARED_PER_SAMPLE * weight.sum())))
    return spaced_rows(len(weight), count)


def _answers(rows: Rows, model: TorqueModel) -> tuple[Array, Array]:
    """Return mean and standard deviation without floor, (N, n) each, of finite rows.

    Both are the posterior's. Learning never uses the fallback of a prediction, because sums over samples remain sums
    only if innovations are linear in the torque.
    """
    evaluator = model.evaluator.revised(model.evaluator.packed, np.zeros(model.n_joints))
    mean, std, *_ = evaluator.many(rows.q, rows.dq, rows.ddq, deflections=rows.deflections)
    return mean, std
