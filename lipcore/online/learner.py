"""Learn online: a trained version and the sums of the rows since."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel, TrainingTorque
from lipcore.online.batch import Rows
from lipcore.online.regime import WALK, Regime, Walk
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import Statistics, add_to, empty

CHUNK_ROWS = 500
"""Rows of features that are computed together: 28 MB for a thousand variables."""
NovelRowsCallback = Callable[[NDArray[np.bool_]], None]
"""Receives a mask, (N,), of the rows that lie outside the basis; see `uncovered`."""


@dataclass(frozen=True)
class OnlineModel:
    """A trained version and what it has learnt since; immutable, every method returns a new one.

    The posterior is a function of the rows learnt, not of their order. A row of event time t has its own weight (see
    `data.independence`) times exp(−(reference − t) / forgetting_s), if there is forgetting. Forgotten rows leave their
    mean and the prior's uncertainty; forgotten training samples leave the version's mean. A change starts a new regime,
    whose prior has the mean learnt before and the variance of an unknown robot. Friction may also drift, see `Walk`:
    event time is then divided into epochs, each with its own friction, and predictions use the newest. Everything else
    is common to all epochs.
    """

    base: TorqueModel
    """The version as trained."""
    forgetting_s: float | None
    since: float | None
    """When the version's own samples begin to be forgotten, s; by default the time of the first row."""
    reference: float
    """Event time that weights refer to, s: the latest so far."""
    before: Regime | None
    """The regime before the last change, which late rows can still reach."""
    now: Regime
    walk: Walk | None = None
    """How friction drifts; None if it is constant."""

    @classmethod
    def start(
        cls,
        base: TorqueModel,
        forgetting_s: float | None = None,
        since: float | None = None,
    ) -> OnlineModel:
        """Return a version as trained, with nothing learnt yet.

        forgetting_s: time constant of forgetting, s, None for never; since: event time, s, from which the version's own
        samples are forgotten. Raise ValueError for an invalid time, or for a model that has already learnt.
        """
        _check(forgetting_s)
        statistics = base.posterior.statistics
        if statistics is None:
            raise ValueError("the model has already learnt online, expected a model as trained")
        # (I + A) ŵ = b: samples with the mean ŵ have A ŵ = b − ŵ, and the prior around ŵ adds the rest
        centre = base.posterior.basis.root.T @ base.posterior.weights
        sums = Statistics(statistics.a, statistics.b - centre, 0.0)
        reference = -math.inf if since is None else since
        now = Regime(-math.inf, centre, sums)
        return cls(base, forgetting_s, since, reference, None, now)

    @property
    def samples(self) -> float:
        """Return the sum of the weights of the rows learnt in this regime."""
        return self.now.samples

    def begin(self, since: float) -> OnlineModel:
        """Set the event time, s, from which the version's own samples are forgotten, if it is not set yet."""
        if self.since is not None:
            return self
        return replace(self, since=since, reference=max(self.reference, since), walk=_begin_walk(self.walk, since))

    def learn(self, rows: Rows, own: bool = False, novel: NovelRowsCallback | None = None) -> OnlineModel:
        """Learn the rows of code 0, in any order.

        Rows from before the previous regime are ignored. Rows of a folded epoch count in the oldest epoch that is
        stored. own: whether nobody else uses these sums (see `detached`), so that they are overwritten. This model must
        then not be used again, and the last of a series must be `symmetrised`. The result is the same to the last bit.
        novel: called for the rows as they are learnt, because their features show whether the basis covers them.
        """
        return self._add(rows.learnt, own, novel)

    def detached(self) -> OnlineModel:
        """Return the same model with sums of its own, which can be overwritten."""
        drifts = self.walk is not None
        return replace(self, before=self.before and self.before.detached(drifts), now=self.now.detached(drifts))

    def change(self, at: float) -> OnlineModel:
        """Start a new regime at an event time: keep the mean and reset its uncertainty.

        It starts after the latest row learnt, if that is later: a row belongs to one regime for good.
        """
        begins = max(at, math.nextafter(max(self.reference, self.now.begins), math.inf))
        fresh = Regime(begins, self.now.solve(self.walk).mean, empty(len(self.now.centre)))
        return replace(self, before=self.now, now=fresh)

    def with_forgetting(self, forgetting_s: float | None) -> OnlineModel:
        """Return the model with another forgetting time, s; None: never. Raise ValueError unless positive."""
        _check(forgetting_s)
        return replace(self, forgetting_s=forgetting_s)

    def with_walk(self, friction_walk_s: float | None) -> OnlineModel:
        """Return the model with another friction drift from now on; unchanged if it is the same.

        friction_walk_s: s, None for never; raise ValueError unless positive.
        """
        if friction_walk_s == (None if self.walk is None else self.walk.time_s):
            return self
        # the sums so far become the past of the first epoch, one step before it
        fresh = self.since is None or self.reference <= self.since
        now, before = (each and each.closed(self.walk, -WALK.cold if fresh else -1) for each in (self.now, self.before))
        assert now is not None
        walk = None
        if friction_walk_s is not None:
            walk = Walk.of(self.base, friction_walk_s, None if self.since is None else self.reference)
        return replace(self, now=now, before=before, walk=walk)

    @property
    def training_torque(self) -> TrainingTorque | None:
        """Return the version's, for the fallback of predictions; None after a change and with forgetting.

        These widen the variance of torques; their mean is still the best estimate.
        """
        return self.base.training_torque if self.before is None and self.forgetting_s is None else None

    def model(self, floor: Array | None = None) -> TorqueModel:
        """Solve for the model that predicts. floor: (n,) (N·m)², the min of its variances."""
        posterior = self.base.posterior
        updated = CompactPosterior.solved(
            posterior.kernel,
            posterior.basis,
            self.now.solve(self.walk, len(posterior.basis.outputs)),
            posterior.noise_variance,
            posterior.std_factor,
            None if floor is None else np.array(floor, np.float64),
            posterior.misfit,
        )
        return replace(self.base, posterior=updated, training_torque=self.training_torque)

    def symmetrised(self) -> OnlineModel:
        """Return the same model with both triangles of its sums, after learning with `own`."""
        for regime in (self.now, self.before):
            if regime is not None:
                regime.symmetrise()
        return self

    def _add(self, rows: Rows, own: bool, novel: NovelRowsCallback | None) -> OnlineModel:
        if not len(rows):
            return self
        model = self if own else self.detached()
        parts = (
            [rows]
            if len(rows) <= CHUNK_ROWS
            else [rows.take(slice(i, i + CHUNK_ROWS)) for i in range(0, len(rows), CHUNK_ROWS)]
        )
        for part in parts:
            model = model._add_chunk(part, novel)
        return model if own else model.symmetrised()

    def _add_chunk(self, rows: Rows, novel: NovelRowsCallback | None) -> OnlineModel:
        latest = max(self.reference, float(rows.time.max()))
        model = self._aged(latest, float(rows.time.min()) if self.since is None else self.since)
        current = rows.time >= model.now.begins
        now, before = model.now, model.before
        if current.any():
            taken = rows if current.all() else rows.take(current)
            now = model._learnt(now, taken, novel)
        if before is not None and (late := ~current & (rows.time >= before.begins)).any():
            before = model._learnt(before, rows.take(late), novel)
            # folded epochs of `now` keep the centre of that time: a share √(1 − s) of this one, which is near 1
            now = replace(now, centre=before.solve(model.walk).mean)
        return replace(model, now=now, before=before)

    def _learnt(self, regime: Regime, rows: Rows, novel: NovelRowsCallback | None) -> Regime:
        """Return a regime, overwritten, with the rows added."""
        if self.walk is None:
            return replace(regime, statistics=self._summed(regime.statistics, rows, novel))
        numbers = regime.place(self.walk.number(rows.time))
        for number in sorted(set(numbers.tolist())):
            of_epoch = numbers == number
            part = rows if of_epoch.all() else rows.take(of_epoch)
            regime = regime.with_epoch(number, self._summed(regime.of_epoch(number), part, novel))
        return regime.folded(self.walk)

    def _summed(self, statistics: Statistics, rows: Rows, novel: NovelRowsCallback | None) -> Statistics:
        """Return these statistics, overwritten, with the rows added."""
        posterior, motion = self.base.posterior, rows.motion()
        weights = rows.weight
        if self.forgetting_s is not None:
            weights = weights * np.exp((rows.time - self.reference) / self.forgetting_s)
        residual = rows.tau - posterior.kernel.mean(motion)
        features, open_ = posterior.basis.features_and_uncovered(motion)
        if novel is not None:
            novel(np.any(open_ > posterior.noise_variance, axis=1))
        return add_to(statistics, features, posterior.row_variance(motion) + open_, residual, weights)

    def _aged(self, reference: float, since: float) -> OnlineModel:
        """Return this model with the weights of a later reference time. The sums of this model are overwritten."""
        age = reference - max(self.reference, since)
        walk = _begin_walk(self.walk, since)
        if self.forgetting_s is None or age <= 0:
            return replace(self, reference=reference, since=since, walk=walk)
        factor = math.exp(-age / self.forgetting_s)
        now, before = self.now.decayed(factor), self.before and self.before.decayed(factor)
        return replace(self, reference=reference, since=since, now=now, before=before, walk=walk)


def uncovered(base: TorqueModel, rows: Rows) -> NDArray[np.bool_]:
    """Return which rows, (N,), lie outside a version's basis: it leaves more variance of a torque than noise has."""
    basis, motion = base.posterior.basis, rows.motion()
    open_ = basis.uncovered(motion, basis.features(motion))
    novel = np.asarray((open_ > base.posterior.noise_variance).any(1))
    return novel


def _check(forgetting_s: float | None) -> None:
    if forgetting_s is not None and not 0 < forgetting_s < math.inf:
        raise ValueError(f"forgetting_s is {forgetting_s!r}, expected a positive number of seconds, or None")


def _begin_walk(walk: Walk | None, since: float) -> Walk | None:
    """Return the walk with its first epoch beginning at `since`, if that is not set yet."""
    return replace(walk, since=since) if walk is not None and walk.since is None else walk
