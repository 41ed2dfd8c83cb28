"""Conformal factors: how much intervals must be widened to reach their coverage on held-out training blocks.

Split conformal prediction over blocks (Vovk et al. 2005; Dunn, Wasserman and Ramdas 2023 for samples in groups). The
hyperparameters and the linearisation of the basis were fitted to all blocks. They stay as they are when one is held
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lipcore.data.metrics import LEVEL, blocks, quantile
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import GUARD_S
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import cholesky

MAX_SCALE = 1e12


@dataclass(frozen=True)
class Conformal:
    """Factor on the half width of each joint's intervals, with the evidence for it."""

    scale: tuple[float, ...]
    """Factor of each joint, (n,), at least 1: the finite-sample quantile of the scores. A score is |error| divided by
    the half width of the model. If there are too few blocks for it, the factor is the plain quantile of the scores."""
    guaranteed: tuple[float, ...]
    """Min average coverage of another such block by intervals of this scale, (n,), as guaranteed by this number of
    blocks."""
    blocks: int
    """Number of blocks."""

    def __post_init__(self) -> None:
        """Raise ValueError for values that `fit_conformal` cannot return."""
        object.__setattr__(self, "scale", tuple(self.scale))
        object.__setattr__(self, "guaranteed", tuple(self.guaranteed))
        if not all(1.0 <= each <= MAX_SCALE for each in self.scale):
            raise ValueError(f"scale is {list(self.scale)}, expected numbers from 1 to {MAX_SCALE:g}")
        if not all(0.0 <= each < 1.0 for each in self.guaranteed) or len(self.guaranteed) != len(self.scale):
            raise ValueError(f"guaranteed is {list(self.guaranteed)}, expected a share from 0 to 1 for each scale")
        if self.blocks < 1:
            raise ValueError(f"blocks is {self.blocks}, expected at least 1")

    def replaced(self, joints: Sequence[int], other: Conformal) -> Conformal:
        """Return these factors with those of some joints, numbered from 0, from `other`."""
        mine = [zip(self.scale, self.guaranteed, strict=True), zip(other.scale, other.guaranteed, strict=True)]
        pairs = [two if joint in joints else one for joint, (one, two) in enumerate(zip(*mine, strict=True))]
        scale, guaranteed = zip(*pairs, strict=True)
        return Conformal(scale, guaranteed, min(self.blocks, other.blocks))

    def widened(self, factors: Sequence[float]) -> Conformal:
        """Return these factors with the scales multiplied by `factors`, (n,), at least 1."""
        return replace(self, scale=tuple(np.multiply(self.scale, factors).tolist()))


def fit_conformal(posterior: CompactPosterior, samples: Samples, variance: Array) -> Conformal:
    """Return the factors from the samples of a posterior, in blocks of a second or whole episodes.

    samples: N, in any order; variance: (N, n) (N·m)², of each torque when it was learnt, without the variance outside
    the basis. Raise NotPositiveDefiniteError if a block cannot be held out.
    """
    order = np.lexsort((samples.t, samples.episode))
    ordered = samples.rows(order)
    starts = blocks(ordered)
    return conformal_of(scores(posterior, ordered, variance[order], starts), starts)


def conformal_of(score: Array, starts: NDArray[np.int64]) -> Conformal:
    """Return the factors from scores of N samples in order, (N, n): |error| / half width of the 95 % interval.

    The scores are those of a model that has not seen the sample's block; starts: first row of each block.
    """
    scale, guaranteed = _quantile(score, np.diff(starts, append=len(score)))
    return Conformal(scale, guaranteed, len(starts))


def scores(posterior: CompactPosterior, samples: Samples, variance: Array, starts: NDArray[np.int64]) -> Array:
    """Return |error| / half width of the 95 % interval, (N, n), of a posterior without the row's surroundings.

    The surroundings are the row's block, and GUARD_S of its episode on both sides. samples: N of the posterior, in
    order; variance: as in `fit_conformal`; starts: first row of each block. With N(ŵ, Σ) of the
    whitened variables, P = φᵀΣφ among the torques that are held out, and R their variances,

        error     (I − P R⁻¹)⁻¹ (y − E y − φᵀŵ)
        variance  (I − P R⁻¹)⁻¹ P, plus the variance outside the basis

    as if their φ R⁻¹ φᵀ had been subtracted from the statistics.
    """
    assert posterior.statistics is not None  # online posteriors have no single sum
    basis, motion, n = posterior.basis, samples.motion(), samples.n_joints
    features = basis.features(motion)
    beyond = basis.uncovered(motion, features)
    root = np.sqrt(variance + beyond).reshape(-1)
    known = cholesky(posterior.statistics.a + np.eye(len(basis)))
    error = (samples.tau - posterior.kernel.mean(motion)).reshape(-1)
    error = (error - known.solve(posterior.statistics.b) @ features) / root
    whitened = known.whiten(features) / root
    stated = posterior.noise_variance + posterior.misfit.variance(motion)
    out = np.empty(samples.tau.shape)
    for first, last in zip(starts, [*starts[1:], len(out)], strict=True):
        rows = _guard_rows(samples, int(first), int(last))
        torques = slice(rows.start * n, rows.stop * n)
        share = whitened[:, torques].T @ whitened[:, torques]
        rest = cholesky(np.eye(len(share)) - share)
        left = rest.solve(share).diagonal() * root[torques] ** 2
        function = posterior.std_factor**2 * (left.reshape(-1, n) + beyond[rows])
        half = quantile(LEVEL) * np.sqrt(stated[rows] + function)
        missed = np.abs(rest.solve(error[torques]) * root[torques]).reshape(-1, n) / half
        out[first:last] = missed[first - rows.start : last - rows.start]
    return out


def _guard_rows(samples: Samples, first: int, last: int) -> slice:
    """Return rows first to last (exclusive), and the rows of their first and last episode within GUARD_S of them."""
    t, episode = samples.t, samples.episode
    before = (episode[:first] == episode[first]) & (t[:first] > t[first] - GUARD_S)
    after = (episode[last:] == episode[last - 1]) & (t[last:] < t[last - 1] + GUARD_S)
    return slice(first - int(before.sum()), last + int(after.sum()))


def _quantile(score: Array, rows: NDArray[np.int64]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the scale and the guaranteed level of each joint, from scores (N, n) of B blocks of `rows` (B,) rows.

    F_b(s) is the share of a block's scores up to s. The scale is the min s >= 1 with Σ F_b(s) / (B + 1) >= LEVEL. If
    there is none, it is the min s with Σ F_b(s) / B >= LEVEL. The guaranteed level is Σ F_b(s) / (B + 1) at that s.
    """
    count, weight = len(rows), np.repeat(1 / rows, rows)
    needed = LEVEL * (count + 1 if LEVEL * (count + 1) <= count else count)
    scale, guaranteed = [], []
    for column in score.T:
        order = np.argsort(column)
        held = np.cumsum(weight[order])
        place = min(int(np.searchsorted(held, needed - 1e-9)), len(column) - 1)
        scale.append(max(1.0, float(column[order[place]])))
        guaranteed.append(float(weight[column <= scale[-1]].sum()) / (count + 1))
    return tuple(scale), tuple(guaranteed)
