"""What is known of a robot between two changes: sums of its rows, epoch by epoch where its friction drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.kernels.friction import FrictionKernel
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.drift import Drift
from lipcore.posterior.linalg import mirror
from lipcore.posterior.statistics import Solution, Statistics, copied, decay, empty, solve


@dataclass(frozen=True)
class WalkOptions:
    """How friction drifts.

    On benchmarks/studies/drifting_friction.py (seeds 50 and 51), a third or three times `share`, ten times `min_size`,
    and half or twice `epochs` moved the nMSE of no case by more than 1 %.
    """

    share: float = 0.3
    """Standard deviation of a coefficient's change in one time constant of its walk, as a share of its size."""
    min_size: float = 0.03
    """Min size of a coefficient, in its prior standard deviations."""
    epochs: int = 10
    """Epochs in a time constant: friction is taken to stand still for as long as an epoch lasts."""
    kept: int = 4
    """Epochs whose rows can still come; earlier ones are folded into what is known of before."""
    cold: int = 10
    """Epochs between a version's own samples and the first row of a stream: the arm may have been switched off. One
    epoch or four time constants did as well there over the first two minutes, within 2 % of the nMSE."""


WALK = WalkOptions()


@dataclass(frozen=True)
class Walk:
    """How friction drifts: a random walk in steps of one epoch.

    time_s: s in which a coefficient changes by `share` of its trained size; since: event time, s, at which epoch 0
    begins, None before the first row.
    """

    time_s: float
    since: float | None
    drift: Drift

    @classmethod
    def of(cls, base: TorqueModel, time_s: float, since: float | None = None) -> Walk:
        """For a version as trained; raise ValueError for a wrong time, or an estimator without friction."""
        if not 0 < time_s < math.inf:
            raise ValueError(f"friction_walk_s is {time_s!r}, expected a positive number of seconds, or None")
        basis = base.posterior.basis
        term = next((each for each in basis.linear if isinstance(each, FrictionKernel)), None)
        if term is None:
            raise ValueError(f"estimator {base.estimator.name!r} has no friction that could drift")
        places = np.arange(len(basis))[basis.rows(term)]
        # whitened, a coefficient is in units of its prior deviation, and B is diagonal for it
        size = np.abs((basis.root.diagonal() * base.posterior.weights)[places]).clip(WALK.min_size)
        return cls(time_s, since, Drift(places, np.minimum(np.square(WALK.share * size) / WALK.epochs, 1.0)))

    def number(self, time: Array) -> NDArray[np.int64]:
        """Epochs of event times, (N,): those before the first belong to it."""
        assert self.since is not None  # there are rows
        return np.maximum(np.floor((time - self.since) * (WALK.epochs / self.time_s)), 0.0).astype(np.int64)


@dataclass(frozen=True)
class Epoch:
    """Sums of the rows of one epoch. shared: whether others have them too, so that they are not to be overwritten."""

    number: int
    statistics: Statistics
    shared: bool = False

    def writable(self) -> Statistics:
        """The sums, which can be added to."""
        return copied(self.statistics) if self.shared else self.statistics


@dataclass(frozen=True)
class Regime:
    """What is known of a robot between two changes: a prior N(centre, I) and the sums of its rows since.

    begins: event time, s. centre: (M,) whitened variables. The trained version is in the sums of the first regime: as
    samples that say its mean, which is the centre. Where friction drifts, `statistics` are what is known of the
    variables at epoch `at`, and `epochs` the rows since, rising; else all rows are in `statistics`. shared: whether
    others have `statistics`, too.
    """

    begins: float
    centre: Array
    statistics: Statistics
    at: int = -1
    epochs: tuple[Epoch, ...] = ()
    shared: bool = False

    @property
    def samples(self) -> float:
        """Sum of the weights of the rows."""
        return self.statistics.samples + sum(each.statistics.samples for each in self.epochs)

    def sums(self, walk: Walk | None) -> Statistics:
        """What the rows say of the variables in the newest epoch."""
        return self.folded(walk, 0).statistics

    def solve(self, walk: Walk | None = None, first: int = 0) -> Solution:
        """Posterior of the whitened variables, friction that of the newest epoch. first: see `Solution`."""
        return solve(self.sums(walk), self.centre, first)

    def folded(self, walk: Walk | None, kept: int = WALK.kept) -> Regime:
        """The same knowledge with at most `kept` epochs left: friction of the others is eliminated for good."""
        regime = self
        while walk is not None and len(regime.epochs) > kept:
            first = regime.epochs[0]
            past = walk.drift.ahead(regime.statistics, regime.centre, first.number - regime.at)
            # sums of rows that come are added to one triangle, see `add_to`
            past = Statistics(
                past.a + first.statistics.a, past.b + first.statistics.b, past.samples + first.statistics.samples
            )
            regime = replace(regime, statistics=past, at=first.number, epochs=regime.epochs[1:], shared=False)
        return regime

    def closed(self, walk: Walk | None, at: int) -> Regime:
        """The same knowledge without epochs, as that of epoch `at`, in sums that can be added to."""
        regime = self.folded(walk, 0)
        statistics = copied(regime.statistics) if regime.shared else regime.statistics
        return replace(regime, statistics=statistics, at=at, shared=False)

    def place(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """The epochs in which rows of such epochs count: the oldest one kept for those that are folded."""
        folded = numbers <= self.at
        return np.where(folded, self.epochs[0].number, numbers) if folded.any() else numbers

    def of_epoch(self, number: int) -> Statistics:
        """Sums of an epoch, which can be added to."""
        for each in self.epochs:
            if each.number == number:
                return each.writable()
        return empty(len(self.centre))

    def with_epoch(self, number: int, statistics: Statistics) -> Regime:
        """The same with these sums of an epoch."""
        others = [each for each in self.epochs if each.number != number]
        epochs = sorted([*others, Epoch(number, statistics)], key=lambda each: each.number)
        return replace(self, epochs=tuple(epochs))

    def decayed(self, factor: float) -> Regime:
        """The same with rows that count a factor as much; its sums are overwritten, those that others have are not."""
        epochs = [Epoch(each.number, decay(each.statistics, factor, own=not each.shared)) for each in self.epochs]
        past = decay(self.statistics, factor, own=not self.shared)
        return replace(self, statistics=past, epochs=tuple(epochs), shared=False)

    def detached(self, drifts: bool) -> Regime:
        """The same with sums of its own, which can be added to. drifts: whether there are epochs, which are then copied
        one by one as they are added to, since most of them are not."""
        epochs = tuple(replace(each, shared=True) for each in self.epochs)
        if drifts:
            return replace(self, epochs=epochs, shared=True)
        return replace(self, statistics=copied(self.statistics), epochs=epochs)

    def symmetrise(self) -> None:
        """Make both triangles of the sums equal, once rows were added; those that others have are so already."""
        if not self.shared:
            mirror(self.statistics.a)
        for each in self.epochs:
            if not each.shared:
                mirror(each.statistics.a)
