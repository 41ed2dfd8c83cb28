"""Weights that drift from step to step: what sums over samples say of them some steps later."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.posterior.linalg import cholesky
from lipcore.posterior.statistics import Statistics, mirror


@dataclass(frozen=True)
class Drift:
    """A random walk of f of the M whitened variables, which is drawn back so slowly that they keep their prior.

    In one step the deviation d of a variable from its centre becomes

        d' = √(1 − s) d + N(0, s),

    so that N(centre, 1) beforehand is N(centre, 1) after any number of steps: variance is added, but never beyond what
    was possible at first. places: (f,) of the variables; step: (f,) s, from 0, which stands still, to 1.
    """

    places: Tensor
    step: Tensor

    def ahead(self, statistics: Statistics, centre: Tensor, steps: int) -> Statistics:
        """Sums that say of the variables `steps` later what these say of them now: earlier ones are integrated out.

        With D = diag(√(1 − s)^steps), or 1 for what stands still, G the columns of the identity at `places`, Q the
        variance s grown over the steps, Q = 1 − (1 − s)^steps, and h = b − A centre:

            A' = D (A − A G Q^½ S⁻¹ Q^½ Gᵀ A) D,   S = I + Q^½ Gᵀ A G Q^½,

        and h alike. centre: (M,) of the prior. A is read from its lower triangle. Raise NotPositiveDefiniteError for
        statistics that no samples have.
        """
        sums = Statistics(statistics.a.clone(), statistics.b, statistics.samples)
        mirror(sums)
        kept = (1 - self.step) ** steps
        root, scale = (1 - kept).sqrt(), torch.ones_like(centre)
        scale[self.places] = kept.sqrt()
        rows = root[:, None] * sums.a[self.places]
        inner = root * rows[:, self.places]
        inner.diagonal().add_(1.0)
        factor = cholesky(inner)
        deviation = sums.b - sums.a @ centre
        explained = factor.whiten(rows)
        right = factor.whiten((root * deviation[self.places])[:, None])[:, 0]
        sums.a.addmm_(explained.T, explained, alpha=-1.0)
        sums.a.mul_(scale[:, None]).mul_(scale)
        mirror(sums)
        deviation = scale * (deviation - explained.T @ right)
        return Statistics(sums.a, deviation + sums.a @ centre, sums.samples)
