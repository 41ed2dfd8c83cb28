"""Rows of a batch before they are learnt: predicted by the version that serves, beside it as trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.adaptive import scores
from lipcore.online.batch import Rows
from lipcore.online.gates import is_implausible
from lipcore.vocabulary import Code

COMPARED, LEAST_COMPARED = 4.0, 10
"""Rows that are compared with the version as trained, for each effective row, and of a batch at least: neighbours of a
fast stream say the same, and each prediction takes time of a core."""


class Version(Protocol):
    """A version that serves. model: with what it has learnt; base: as trained; version: its number."""

    @property
    def model(self) -> TorqueModel: ...  # noqa: D102

    @property
    def base(self) -> TorqueModel: ...  # noqa: D102

    @property
    def version(self) -> int: ...  # noqa: D102


@dataclass(frozen=True)
class Trained:
    """What the version as trained, which learns nothing, predicts of some of the P rows that were predicted.

    rows: (M,), their places among these; share: rows that each stands for; mean, std: (M, n).
    """

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
class Answered:
    """What a stream has answered N rows with. mean, std: (N, n); factor: (N, n), on half the width of its intervals.

    other_load: whether that was with another load than the arm carries by what is known now: it had noticed none, or
    one that is gone. Rows are then judged by what is known now.
    """

    mean: Array
    std: Array
    factor: Array | None = None
    other_load: bool = False

    def take(self, rows: NDArray[np.bool_]) -> Answered:
        """Those of some of the rows, (N,)."""
        factor = None if self.factor is None else self.factor[rows]
        return Answered(self.mean[rows], self.std[rows], factor, self.other_load)


@dataclass(frozen=True)
class Screened:
    """Rows, and the predictions of the version that serves for those that passed so far.

    own: which of the rows are of this batch, the others had waited for it. asked: (N,), rows with a finite answer, at
    rest or not; predicted: (N,); mean, std, bare: (P, n) of these, bare the standard deviation without the floor that
    past errors put under `std`. noise_std: (n,). version: its number; scale: of its intervals as trained, (n,).
    trained: see there; None where nothing is compared with it. seen: what intervals are judged by. answered: of the P
    rows, where that was with another load.
    """

    rows: Rows
    own: slice
    asked: NDArray[np.bool_]
    predicted: NDArray[np.bool_]
    mean: Array
    std: Array
    bare: Array
    noise_std: Array
    version: int
    scale: Array
    trained: Trained | None = None
    seen: Seen | None = None
    answered: Answered | None = None

    @property
    def until(self) -> float | None:
        """Latest event time of the rows that were predicted, s; None where there are none."""
        return float(self.rows.time[self.predicted].max()) if self.predicted.any() else None


def predict(
    rows: Rows,
    version: Version,
    own: slice,
    answered: Answered | None = None,
    carrying: TorqueModel | None = None,
) -> Screened:
    """Let a version predict the rows that passed, with what it has learnt and as trained; those it has no finite answer
    for are beyond its limits, and those whose torque nobody has measured are implausible. answered: of all rows, where
    a stream has answered them already; carrying: the version with what the arm carries, where it does: it is compared
    with the version as trained no more."""
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
        given = Answered(mean, std)
    known = np.asarray(np.isfinite(mean).all(axis=1) & np.isfinite(std).all(axis=1))
    invented, gravity = np.zeros_like(known), model.torque_convention == "gravity_included"
    invented[known] = is_implausible(good.tau[known], given.mean[known], model.noise_std, gravity)
    known &= ~invented
    reached = given.take(known)
    score = scores(good.tau[known] - reached.mean, reached.std, model.noise_std)
    seen = Seen(good.time[known], score, reached.factor)
    answerable = asked.copy()
    answerable[asked] = known
    judged, known = known & predicted[asked], known[predicted[asked]]
    codes[predicted] = np.where(known, Code.LEARNT, Code.LIMIT)
    codes[np.flatnonzero(asked)[invented]] = Code.IMPLAUSIBLE
    predicted[predicted] = known
    mean, std, bare = mean[judged], std[judged], bare[judged]
    return Screened(
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


def _as_trained(rows: Rows, version: Version, mean: Array, bare: Array) -> Trained:
    """What the version as trained predicts of some of the rows, of which it predicts mean and bare, (P, n), by now."""
    compared = evenly(rows.weight)
    same = version.model is version.base
    answers = (mean[compared], bare[compared]) if same else _answers(rows.take(compared), version.base)
    return Trained(compared, len(rows) / max(1, len(compared)), *answers)


def evenly(weight: Array) -> NDArray[np.int64]:
    """Places of the rows that are compared, out of rows of these weights, (N,)."""
    count = min(len(weight), max(LEAST_COMPARED, int(np.ceil(COMPARED * weight.sum()))))
    return np.linspace(0, len(weight) - 1, count).round().astype(np.int64)


def _answers(rows: Rows, model: TorqueModel) -> tuple[Array, Array]:
    """Mean and standard deviation, without floor, of rows that are finite: (N, n) each.

    These are the posterior's. Learning never sees the fallback of an answer, because sums over samples stay sums only
    if innovations are linear in the torque.
    """
    evaluator = model.evaluator.revised(model.evaluator.packed, np.zeros(model.n_joints))
    mean, std, *_ = evaluator.many(rows.q, rows.dq, rows.ddq)
    return mean, std
