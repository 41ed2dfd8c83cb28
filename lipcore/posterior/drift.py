"""Drift of weights from step to step: propagation of sums over samples by some steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Array, Indices
from lipcore.posterior.linalg import add_diagonal, cholesky, mirror
from lipcore.posterior.statistics import Statistics


@dataclass(frozen=True)
class Drift:
    """Random walk of f of the M whitened variables, with a slow pull to their centre that preserves their prior.

    In one step the deviation d of a variable from its centre becomes

        d' = √(1 − s) d + N(0, s),

    so that the prior N(centre, 1) stays N(centre, 1) after any number of steps. Variance is added, but never beyond the
    initial one. places: (f,) of the variables; step: (f,) s, from 0 (no drift) to 1.
    """

    places: Indices
    step: Array

    def ahead(self, statistics: Statistics, centre: Array, steps: int) -> Statistics:
        """Return the sums about the variables `steps` later. The earlier variables are integrated out.

        With D = diag(√(1 − s)^steps), or 1 for variables without drift, G the columns of the identity at `places`, Q
        the variance s accumulated over the steps, Q = 1 − (1 − s)^steps, and h = b − A centre:

            A' = D (A − A G Q^½ S⁻¹ Q^½ Gᵀ A) D,   S = I + Q^½ Gᵀ A G Q^½,

        and the same for h. centre: (M,), mean of the prior. A is read from its lower triangle. Raise
        NotPositiveDefiniteError for statistics that no samples can have.
        """
        sums = Statistics(statistics.a.copy(), statistics.b, statistics.samples)
        mirror(sums.a)
        kept = (1 - self.step) ** steps
        root, scale = np.sqrt(1 - kept), np.ones_like(centre)
        scale[self.places] = np.sqrt(kept)
        rows = root[:, None] * sums.a[self.places]
        inner = root * rows[:, self.places]
        add_diagonal(inner, 1.0)
        factor = cholesky(inner)
        deviation = sums.b - sums.a @ centre
        explained = factor.whiten(rows)
        right = factor.whiten(root * deviation[self.places])
        sums.a[:] -= explained.T @ explained
        sums.a[:] *= scale[:, None] * scale
        mirror(sums.a)
        deviation = scale * (deviation - explained.T @ right)
        return Statistics(sums.a, deviation + sums.a @ centre, sums.samples)
