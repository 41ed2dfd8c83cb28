"""What left-out blocks of the training say of a posterior's intervals: a factor on their widths that these prove.

Split conformal prediction over blocks (Vovk et al. 2005; Dunn, Wasserman and Ramdas 2023 for samples in groups). What
was fitted to all blocks, hyperparameters and what the basis is linearised around, stays when one is left out.
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
    """The factor on the half width of each joint's intervals, (n,), at least 1, and what it stands on.

    scale: the finite-sample quantile of the scores, |error| over the half width that the model believes; where there
    are too few blocks for one, their plain quantile; guaranteed: (n,), the share of the measurements of another such
    block that intervals of this scale hold at least, on average, as far as so many blocks can say; blocks: how many.
    """

    scale: tuple[float, ...]
    guaranteed: tuple[float, ...]
    blocks: int

    def __post_init__(self) -> None:
        """Raise ValueError for what no blocks say."""
        object.__setattr__(self, "scale", tuple(self.scale))
        object.__setattr__(self, "guaranteed", tuple(self.guaranteed))
        if not all(1.0 <= each <= MAX_SCALE for each in self.scale):
            raise ValueError(f"scale is {list(self.scale)}, expected numbers from 1 to {MAX_SCALE:g}")
        if not all(0.0 <= each < 1.0 for each in self.guaranteed) or len(self.guaranteed) != len(self.scale):
            raise ValueError(f"guaranteed is {list(self.guaranteed)}, expected a share from 0 to 1 for each scale")
        if self.blocks < 1:
            raise ValueError(f"blocks is {self.blocks}, expected at least 1")

    def widened(self, factors: Sequence[float]) -> Conformal:
        """The same with scales times factors, (n,), at least 1."""
        return replace(self, scale=tuple(np.multiply(self.scale, factors).tolist()))


def conform(posterior: CompactPosterior, samples: Samples, variance: Array) -> Conformal:
    """The factor that the samples behind a posterior prove, in blocks of a second or whole episodes.

    samples: N, in any order; variance: (N, n) (N·m)², with which each torque of them has taught, beside what the basis
    leaves open. Raise NotPositiveDefiniteError where a block cannot be left out.
    """
    order = np.lexsort((samples.t, samples.episode))
    ordered = samples.rows(order)
    starts = blocks(ordered)
    score = scores(posterior, ordered, variance[order], starts)
    scale, guaranteed = _quantile(score, np.diff(starts, append=len(score)))
    return Conformal(scale, guaranteed, len(starts))


def scores(posterior: CompactPosterior, samples: Samples, variance: Array, starts: NDArray[np.int64]) -> Array:
    """|error| over half the width of the 95 % interval, (N, n), of a posterior without the row's block and GUARD_S of
    its episode on both sides.

    samples: N behind the posterior, in order; variance: as of `conform`; starts: first row of each block. With the
    whitened variables' posterior N(ŵ, Σ), P = φᵀΣφ among the torques that are left out and R their variances,

        error     (I − P R⁻¹)⁻¹ (y − E y − φᵀŵ)
        variance  (I − P R⁻¹)⁻¹ P, and what the basis leaves open

    as if their φ R⁻¹ φᵀ had been subtracted from the statistics.
    """
    assert posterior.statistics is not None  # as trained
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
        rows = _guarded(samples, int(first), int(last))
        torques = slice(rows.start * n, rows.stop * n)
        share = whitened[:, torques].T @ whitened[:, torques]
        rest = cholesky(np.eye(len(share)) - share)
        left = rest.solve(share).diagonal() * root[torques] ** 2
        function = posterior.std_factor**2 * (left.reshape(-1, n) + beyond[rows])
        half = quantile(LEVEL) * np.sqrt(stated[rows] + function)
        missed = np.abs(rest.solve(error[torques]) * root[torques]).reshape(-1, n) / half
        out[first:last] = missed[first - rows.start : last - rows.start]
    return out


def _guarded(samples: Samples, first: int, last: int) -> slice:
    """Rows first to last, last exclusive, and those of their first and last episode that are nearer than GUARD_S."""
    t, episode = samples.t, samples.episode
    before = (episode[:first] == episode[first]) & (t[:first] > t[first] - GUARD_S)
    after = (episode[last:] == episode[last - 1]) & (t[last:] < t[last - 1] + GUARD_S)
    return slice(first - int(before.sum()), last + int(after.sum()))


def _quantile(score: Array, rows: NDArray[np.int64]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Scale and guaranteed level of each joint, from scores (N, n) of B blocks of so many `rows` each.

    With F_b(s) the share of a block's scores up to s, the least s >= 1 with Σ F_b(s) / (B + 1) >= LEVEL, or, where no
    s has, with Σ F_b(s) / B >= LEVEL; guaranteed is Σ F_b(s) / (B + 1) at that s.
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
