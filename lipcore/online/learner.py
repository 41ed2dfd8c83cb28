"""A model that learns: a trained version and the sums of what has come since."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lipcore.data.samples import Array
from lipcore.model.torque_model import TorqueModel
from lipcore.online.batch import Rows
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.statistics import Solution, Statistics, add_to, copied, decay, empty, mirror, solve

CHUNK = 500
"""Rows whose features are computed together: they take 28 MB at a thousand variables."""
Novel = Callable[[NDArray[np.bool_]], None]
"""Called with which of some rows, (N,), lie beyond the basis; see `uncovered`."""


class ForgottenError(ValueError):
    """Rows are to be taken back from a time of which only the conclusion is kept."""


@dataclass(frozen=True)
class Regime:
    """What is known of a robot between two changes: a prior N(centre, I) and the sums of its rows since.

    begins: event time, s. centre: (M,) whitened variables. The trained version is in the sums of the first regime: as
    samples that say its mean, which is the centre.
    """

    begins: float
    centre: Tensor
    statistics: Statistics

    def solve(self) -> Solution:
        """Posterior of the whitened variables."""
        return solve(self.statistics, self.centre)


@dataclass(frozen=True)
class OnlineModel:
    """A trained version and what it has learnt since; immutable, every method returns another one.

    The posterior is a function of the rows learnt, not of their order: a row of event time t counts its own weight (see
    `data.independence`), times exp(−(reference − t) / forgetting_s) where there is forgetting. What is forgotten leaves
    its mean behind, with the prior's uncertainty: the version as trained where that is forgotten. A change begins a new
    regime, whose prior has the mean of what was known before and the variance that a robot never seen has.

    base: the version as trained; reference: event time, s, that weights refer to, the latest seen; since: when the
    version's own samples begin to be forgotten, the first row's time unless given; before: the regime before the last
    change, which late rows of then still reach.
    """

    base: TorqueModel
    forgetting_s: float | None
    since: float | None
    reference: float
    before: Regime | None
    now: Regime

    @classmethod
    def start(cls, base: TorqueModel, forgetting_s: float | None = None, since: float | None = None) -> OnlineModel:
        """A version as trained, with nothing learnt yet.

        forgetting_s: time constant of forgetting, s, None for never; since: event time, s, from which on the version's
        own samples are forgotten. Raise ValueError for a wrong forgetting time, or a model that has learnt already.
        """
        _check(forgetting_s)
        statistics = base.posterior.statistics
        if statistics is None:
            raise ValueError("the model has learnt online already, expected one as trained")
        # (I + A) ŵ = b: samples that say ŵ have A ŵ = b − ŵ, and the prior around ŵ gives the rest
        centre = base.posterior.basis.root.T @ base.posterior.weights
        sums = Statistics(statistics.a, statistics.b - centre, 0.0)
        reference = -math.inf if since is None else since
        return cls(base, forgetting_s, since, reference, None, Regime(-math.inf, centre, sums))

    @property
    def samples(self) -> float:
        """Sum of the weights of the rows learnt in this regime."""
        return self.now.statistics.samples

    def begin(self, since: float) -> OnlineModel:
        """Say from when on, s of event time, the version's own samples are forgotten, where that is not known yet."""
        if self.since is not None:
            return self
        return replace(self, since=since, reference=max(self.reference, since))

    def learn(self, rows: Rows, own: bool = False, novel: Novel | None = None) -> OnlineModel:
        """Learn the rows of code 0, in any order; those from before the regime before this one teach nothing more.

        own: whether nobody else has these sums (see `detached`), so that they can be added to where they are: the model
        that this is called of is not to be used again, the last of many is to be `symmetrised`. The outcome is the same
        to the last bit. novel: called for the rows as they are learnt, since their features show whether the basis
        covers them.
        """
        return self._add(rows.learnt, 1.0, own, novel)

    def unlearn(self, rows: Rows, own: bool = False) -> OnlineModel:
        """Take back rows that were learnt; raise ForgottenError for some from before the regime before this one.

        own: as in `learn`.
        """
        self.check_unlearn(rows)
        return self._add(rows.learnt, -1.0, own)

    def check_unlearn(self, rows: Rows) -> None:
        """Raise ForgottenError where rows cannot be taken back, being from before the regime before this one."""
        oldest = self.now.begins if self.before is None else self.before.begins
        if len(rows.learnt) and float(rows.learnt.time.min()) < oldest:
            raise ForgottenError(f"rows from before {oldest:.3f} s cannot be taken back: two changes have come since")

    def detached(self) -> OnlineModel:
        """The same model with sums of its own, which can be added to."""
        before = self.before and replace(self.before, statistics=copied(self.before.statistics))
        return replace(self, before=before, now=replace(self.now, statistics=copied(self.now.statistics)))

    def change(self, at: float) -> OnlineModel:
        """Begin a new regime at an event time: the mean is kept, its uncertainty is opened.

        It begins after the latest row learnt where that is later: a row belongs to one regime for good.
        """
        begins = max(at, math.nextafter(max(self.reference, self.now.begins), math.inf))
        fresh = Regime(begins, self.now.solve().mean, empty(len(self.now.centre)))
        return replace(self, before=self.now, now=fresh)

    def with_forgetting(self, forgetting_s: float | None) -> OnlineModel:
        """Forget otherwise from here on. forgetting_s: s, None for never; raise ValueError unless above zero."""
        _check(forgetting_s)
        return replace(self, forgetting_s=forgetting_s)

    def model(self, floor: Array | None = None) -> TorqueModel:
        """Solve for the model that answers. floor: (n,) (N·m)², which its variances are never below."""
        posterior = self.base.posterior
        updated = CompactPosterior.solved(
            posterior.kernel,
            posterior.basis,
            self.now.solve(),
            posterior.noise_variance,
            posterior.std_factor,
            None if floor is None else torch.from_numpy(np.array(floor, np.float64)),
            posterior.misfit,
        )
        return replace(self.base, posterior=updated)

    def symmetrised(self) -> OnlineModel:
        """Return the same model with both triangles of its sums, once it has learnt with `own`."""
        for regime in (self.now, self.before):
            if regime is not None:
                mirror(regime.statistics)
        return self

    def _add(self, rows: Rows, sign: float, own: bool, novel: Novel | None = None) -> OnlineModel:
        if not len(rows):
            return self
        model = self if own else self.detached()
        parts = [rows] if len(rows) <= CHUNK else [rows.take(slice(i, i + CHUNK)) for i in range(0, len(rows), CHUNK)]
        for part in parts:
            model = model._add_chunk(part, sign, novel)
        return model if own else model.symmetrised()

    def _add_chunk(self, rows: Rows, sign: float, novel: Novel | None) -> OnlineModel:
        latest = max(self.reference, float(rows.time.max()))
        model = self._aged(latest, float(rows.time.min()) if self.since is None else self.since)
        current = rows.time >= model.now.begins
        now, before = model.now, model.before
        if current.any():
            taken = rows if current.all() else rows.take(current)
            now = replace(now, statistics=model._summed(now.statistics, taken, sign, novel))
        if before is not None and (late := ~current & (rows.time >= before.begins)).any():
            before = replace(before, statistics=model._summed(before.statistics, rows.take(late), sign, novel))
            now = replace(now, centre=before.solve().mean)
        return replace(model, now=now, before=before)

    def _summed(self, statistics: Statistics, rows: Rows, sign: float, novel: Novel | None) -> Statistics:
        """These statistics, overwritten, with the rows added (sign 1) or taken back (−1)."""
        posterior, motion = self.base.posterior, rows.motion()
        weights = torch.from_numpy(rows.weight)
        if self.forgetting_s is not None:
            weights = weights * torch.from_numpy(np.exp((rows.time - self.reference) / self.forgetting_s))
        residual = torch.from_numpy(rows.tau) - posterior.kernel.mean(motion)
        features, open_ = posterior.basis.features_and_uncovered(motion)
        if novel is not None:
            novel((open_ > posterior.noise_variance).any(1).numpy())
        return add_to(statistics, features, posterior.row_variance(motion) + open_, residual, weights, sign)

    def _aged(self, reference: float, since: float) -> OnlineModel:
        """The same knowledge as it weighs at a later reference time; its sums are overwritten."""
        age = reference - max(self.reference, since)
        if self.forgetting_s is None or age <= 0:
            return replace(self, reference=reference, since=since)
        factor = math.exp(-age / self.forgetting_s)
        now = replace(self.now, statistics=decay(self.now.statistics, factor, own=True))
        before = self.before and replace(self.before, statistics=decay(self.before.statistics, factor, own=True))
        return replace(self, reference=reference, since=since, now=now, before=before)


def uncovered(base: TorqueModel, rows: Rows) -> NDArray[np.bool_]:
    """Which rows lie beyond a version's basis: it leaves more variance of a torque open than its noise has, (N,)."""
    basis, motion = base.posterior.basis, rows.motion()
    open_ = basis.uncovered(motion, basis.features(motion))
    novel: NDArray[np.bool_] = (open_ > base.posterior.noise_variance).any(1).numpy()
    return novel


def _check(forgetting_s: float | None) -> None:
    if forgetting_s is not None and not 0 < forgetting_s < math.inf:
        raise ValueError(f"forgetting_s is {forgetting_s!r}, expected a positive number of seconds, or None")
