"""Store what was learnt about a robot between two changes: sums of its rows, per epoch if its friction drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.kernels.drive.kernel import DriveKernel
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.drift import Drift
from lipcore.posterior.linalg import mirror
from lipcore.posterior.statistics import Solution, Statistics, copied, decay, empty, solve


@dataclass(frozen=True)
class WalkOptions:
    """How friction drifts.

    On benchmarks/studies/drifting_friction.py (seeds 50 and 51), a third or three times `share`, ten times `min_size`,
    and half or twice `epochs` changed the nMSE of no case by more than 1 %.
    """

    share: float = 0.3
    """Standard deviation of a coefficient's change in one time constant, as a share of its size."""
    min_size: float = 0.03
    """Min size of a coefficient, in prior standard deviations."""
    epochs: int = 10
    """Epochs in a time constant: friction is constant within an epoch."""
    kept: int = 4
    """Epochs that can still receive rows; earlier ones are folded into the past."""
    cold: int = 10
    """Epochs between a version's own samples and the first row of a stream: the arm may have been switched off. One
    epoch or four time constants gave the same nMSE within 2 % over the first two minutes."""


WALK = WalkOptions()


@dataclass(frozen=True)
class Walk:
    """How friction drifts: a random walk in steps of one epoch."""

    time_s: float
    """Time, s, in which a coefficient changes by `share` of its trained size."""
    since: float | None
    """Event time, s, at which epoch 0 begins; None before the first row."""
    drift: Drift

    @classmethod
    def of(cls, base: TorqueModel, time_s: float, since: float | None = None) -> Walk:
        """Return the walk of a version as trained; raise ValueError if time is invalid or friction is not modelled."""
        if not 0 < time_s < math.inf:
            raise ValueError(f"friction_walk_s is {time_s!r}, expected a positive number of seconds, or None")
        basis = base.posterior.basis
        term = next((each for each in basis.linear if isinstance(each, DriveKernel)), None)
        if term is None:
            raise ValueError(f"estimator {base.estimator.name!r} has no friction term")
        places = np.arange(len(basis))[basis.rows(term)]
        # whitened, a coefficient is in units of its prior deviation, and B is diagonal for it
        size = np.abs((basis.root.diagonal() * base.posterior.weights)[places]).clip(WALK.min_size)
        return cls(time_s, since, Drift(places, np.minimum(np.square(WALK.share * size) / WALK.epochs, 1.0)))

    def number(self, time: Array) -> NDArray[np.int64]:
        """Return the epochs of event times, (N,): times before the first belong to it."""
        assert self.since is not None  # there are rows
        return np.maximum(np.floor((time - self.since) * (WALK.epochs / self.time_s)), 0.0).astype(np.int64)


@dataclass(frozen=True)
class Epoch:
    """Sums of the rows of one epoch. shared: whether others use them, too, so that they must not be overwritten."""

    number: int
    statistics: Statistics
    shared: bool = False

    def writable(self) -> Statistics:
        """Return the sums, copied if they are shared."""
        return copied(self.statistics) if self.shared else self.statistics


@dataclass(frozen=True)
class Regime:
    """What is known of a robot between two changes: a prior N(centre, I) and the sums of its rows since.

    The trained version is part of the sums of the first regime, as samples with the centre as their mean.
    """

    begins: float
    """Event time, s."""
    centre: Array
    """Whitened variables, (M,)."""
    statistics: Statistics
    """If friction drifts, the sums about the variables at epoch `at`; else the sums of all rows."""
    at: int = -1
    epochs: tuple[Epoch, ...] = ()
    """If friction drifts, the rows since `at`, in rising order."""
    shared: bool = False
    """Whether others use `statistics`, too."""

    @property
    def samples(self) -> float:
        """Return the sum of the weights of the rows."""
        return self.statistics.samples + sum(each.statistics.samples for each in self.epochs)

    def sums(self, walk: Walk | None) -> Statistics:
        """Return the sums about the variables of the newest epoch."""
        return self.folded(walk, 0).statistics

    def solve(self, walk: Walk | None = None, first: int = 0) -> Solution:
        """Return the posterior of the whitened variables, with the newest epoch's friction. first: see `Solution`."""
        return solve(self.sums(walk), self.centre, first)

    def folded(self, walk: Walk | None, kept: int = WALK.kept) -> Regime:
        """Return this regime with at most `kept` epochs. The friction of the others is integrated out."""
        regime = self
        while walk is not None and len(regime.epochs) > kept:
            first = regime.epochs[0]
            past = walk.drift.ahead(regime.statistics, regime.centre, first.number - regime.at)
            # new rows are added to one triangle, see `add_to`
            past = Statistics(
                past.a + first.statistics.a, past.b + first.statistics.b, past.samples + first.statistics.samples
            )
            regime = replace(regime, statistics=past, at=first.number, epochs=regime.epochs[1:], shared=False)
        return regime

    def closed(self, walk: Walk | None, at: int) -> Regime:
        """Return this regime with all epochs folded, at epoch `at`, with sums that can be overwritten."""
        regime = self.folded(walk, 0)
        statistics = copied(regime.statistics) if regime.shared else regime.statistics
        return replace(regime, statistics=statistics, at=at, shared=False)

    def place(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the epochs in which rows of these epochs count: for folded ones the oldest that is stored."""
        folded = numbers <= self.at
        return np.where(folded, self.epochs[0].number, numbers) if folded.any() else numbers

    def of_epoch(self, number: int) -> Statistics:
        """Return the sums of an epoch, which can be overwritten."""
        for each in self.epochs:
            if each.number == number:
                return each.writable()
        return empty(len(self.centre))

    def with_epoch(self, number: int, statistics: Statistics) -> Regime:
        """Return the regime with these sums of an epoch."""
        others = [each for each in self.epochs if each.number != number]
        epochs = sorted([*others, Epoch(number, statistics)], key=lambda each: each.number)
        return replace(self, epochs=tuple(epochs))

    def decayed(self, factor: float) -> Regime:
        """Return the regime with the weights times `factor`; its own sums are overwritten, shared ones are not."""
        epochs = [Epoch(each.number, decay(each.statistics, factor, own=not each.shared)) for each in self.epochs]
        past = decay(self.statistics, factor, own=not self.shared)
        return replace(self, statistics=past, epochs=tuple(epochs), shared=False)

    def detached(self, drifts: bool) -> Regime:
        """Return the regime with sums of its own, which can be overwritten. drifts: whether there are epochs.

        Epochs are copied one by one when rows are added, because most of them get none.
        """
        epochs = tuple(replace(each, shared=True) for each in self.epochs)
        if drifts:
            return replace(self, epochs=epochs, shared=True)
        return replace(self, statistics=copied(self.statistics), epochs=epochs)

    def symmetrise(self) -> None:
        """Make both triangles of the sums equal after rows were added; shared sums are equal already."""
        if not self.shared:
            mirror(self.statistics.a)
        for each in self.epochs:
            if not each.shared:
                mirror(each.statistics.a)
