"""What a compact posterior needs to know of the data: sums over samples, and how they are added, aged and solved.

All functions are pure. Sums know no order: fitting all samples at once, or in parts, or one by one, gives the same
posterior, and what has been added can be subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.posterior.basis import Basis
from lipcore.posterior.linalg import NotPositiveDefiniteError

ROUNDING = 1e-8
"""Share of the largest eigenvalue of the statistics by which the smallest may lie below zero."""
BLOCK = 256
"""Rows below which a product with itself is computed at once."""


@dataclass(frozen=True)
class Statistics:
    """A = Σ φ R⁻¹ φᵀ, (M, M), and b = Σ φ R⁻¹ (y − E y), (M,), over samples, each with a weight of one unless aged.

    R: diagonal; of each torque the noise variance and what the basis leaves open, k(x, x) − φᵀφ. So a sample beyond the
    basis teaches the little that it can, instead of being explained by functions that do not reach it (the fully
    independent training conditional of Snelson & Ghahramani, 2006). samples: sum of the weights.
    """

    a: Tensor
    b: Tensor
    samples: float


@dataclass(frozen=True)
class Solution:
    """Posterior N(mean, Σ) of the M whitened variables. learnt: (M, M) lower triangular, learntᵀ learnt = I − Σ."""

    mean: Tensor
    learnt: Tensor


def empty(size: int) -> Statistics:
    """Statistics of no samples, for M = size variables."""
    return Statistics(torch.zeros((size, size), dtype=torch.float64), torch.zeros(size, dtype=torch.float64), 0)


def collect(
    basis: Basis, noise_variance: Tensor, motion: Motion, residual: Tensor, weights: Tensor | None = None
) -> Statistics:
    """Sums over N samples, A = Σ φ R⁻¹ φᵀ and b = Σ φ R⁻¹ residual (eq. 24 of docs/method.md).

    noise_variance: (n,) or (N, n) (N·m)²; residual: torque less its prior mean, (N, n) N·m; weights: (N,),
    what each sample counts, one where None.
    """
    features = basis.features(motion)
    variance = noise_variance + basis.uncovered(motion, features)
    precision = variance.reciprocal() if weights is None else weights[:, None] / variance
    features *= precision.sqrt().reshape(-1)
    b = features @ (residual * precision.sqrt()).reshape(-1)
    return Statistics(_square(features), b, float(len(motion) if weights is None else weights.sum()))


def update(
    statistics: Statistics,
    basis: Basis,
    noise_variance: Tensor,
    motion: Motion,
    residual: Tensor,
    weights: Tensor | None = None,
) -> Statistics:
    """Statistics with N more samples, arguments as of `collect`."""
    return merge(statistics, collect(basis, noise_variance, motion, residual, weights))


def merge(one: Statistics, other: Statistics) -> Statistics:
    """Statistics of the samples of both, from parts, streams or robots that share a basis."""
    return Statistics(one.a + other.a, one.b + other.b, one.samples + other.samples)


def subtract(all_samples: Statistics, some: Statistics) -> Statistics:
    """Statistics without some of their samples: what `merge` did is undone, to rounding."""
    return Statistics(all_samples.a - some.a, all_samples.b - some.b, all_samples.samples - some.samples)


def add_to(
    statistics: Statistics, features: Tensor, variance: Tensor, residual: Tensor, weights: Tensor, sign: float = 1.0
) -> Statistics:
    """Statistics with N samples more, or fewer where sign is −1, that overwrite these: for few samples, often.

    Of A only the lower triangle is kept up, which is all that `solve` reads; `mirror` follows with the other. The same
    to rounding as to `merge` what `collect` finds. features: φ, (M, N n), overwritten; variance: R, (N, n); residual:
    (N, n); weights: (N,).
    """
    root = (weights[:, None] / variance).sqrt()
    features *= root.reshape(-1)
    b = features @ (residual * root).reshape(-1)
    _add_square(statistics.a, features, sign)
    samples = statistics.samples + sign * float(weights.sum())
    return Statistics(statistics.a, statistics.b + sign * b, samples)


def mirror(statistics: Statistics) -> None:
    """Make the upper triangle of A equal to the lower one, in place: what follows a run of `add_to`."""
    statistics.a.copy_(statistics.a.tril() + statistics.a.tril(-1).T)


def decay(statistics: Statistics, factor: float, own: bool = False) -> Statistics:
    """Statistics whose samples count a `factor` from 0 to 1 as much as before; raise ValueError for another.

    own: whether these are not needed any more and may be overwritten, to the same bits.
    """
    if not 0.0 <= factor <= 1.0:
        raise ValueError(f"factor is {factor!r}, expected a number from 0 to 1")
    a, b = statistics.a, statistics.b
    return Statistics(a.mul_(factor) if own else factor * a, factor * b, factor * statistics.samples)


def copied(statistics: Statistics) -> Statistics:
    """The same statistics in memory of their own."""
    return Statistics(statistics.a.clone(), statistics.b.clone(), statistics.samples)


def solve(statistics: Statistics, centre: Tensor | None = None) -> Solution:
    """Posterior of the whitened variables given the statistics, with the prior N(centre, I).

    Mean (I + A)⁻¹ (centre + b), covariance Σ = (I + A)⁻¹. centre: (M,), zero where None.
    Raise NotPositiveDefiniteError for statistics that no samples have.
    """
    right = statistics.b if centre is None else centre + statistics.b
    return _by_cholesky(statistics.a, right) or _by_eigenvalues(statistics.a, right)


def known(mean: Tensor, covariance: Tensor) -> Solution:
    """The posterior N(mean, Σ) of whitened variables, (M,) and (M, M), as it stands; Σ is nowhere above the prior's I.

    Raise NotPositiveDefiniteError where it is.
    """
    explained = -covariance
    explained.diagonal().add_(1.0)
    upper, failed = torch.linalg.cholesky_ex(explained.flip(0, 1), upper=True)
    if not failed:
        return Solution(mean, upper.flip(0, 1))
    values, vectors = torch.linalg.eigh(explained)
    if not float(values[0]) >= -ROUNDING:
        raise NotPositiveDefiniteError(f"a covariance exceeds the prior's by {-float(values[0]):.3g}, expected less")
    root = values.clamp_min(0.0).sqrt()[:, None] * vectors.T
    return Solution(mean, torch.linalg.qr(root.flip(1), mode="r").R.flip(0, 1))


def _by_cholesky(a: Tensor, right: Tensor) -> Solution | None:
    """The posterior where samples tell of every variable, so that I − Σ is positive definite; None elsewhere."""
    total = a.clone()
    total.diagonal().add_(1.0)
    factor, failed = torch.linalg.cholesky_ex(total)
    if failed:
        return None
    explained = torch.cholesky_inverse(factor).neg_()
    explained.diagonal().add_(1.0)
    # with the variables in reverse order, explained = Uᵀ U: the factor that is sought is the lower triangular one
    upper, failed = torch.linalg.cholesky_ex(explained.flip(0, 1), upper=True)
    if failed:
        return None
    return Solution(torch.cholesky_solve(right[:, None], factor)[:, 0], upper.flip(0, 1))


def _by_eigenvalues(a: Tensor, right: Tensor) -> Solution:
    """The same from any statistics, at three times the cost; raise NotPositiveDefiniteError for impossible ones."""
    values, vectors = torch.linalg.eigh(a)
    if not float(values[0]) >= -ROUNDING * max(float(values[-1]), 1.0):
        raise NotPositiveDefiniteError(
            f"statistics of size {len(values)} have the eigenvalue {float(values[0]):.3g}, expected none below zero"
        )
    values = values.clamp_min(0.0)
    mean = vectors @ ((vectors.T @ right) / (1 + values))
    root = (values / (1 + values)).sqrt()[:, None] * vectors.T
    return Solution(mean, torch.linalg.qr(root.flip(1), mode="r").R.flip(0, 1))


def _square(features: Tensor) -> Tensor:
    """F Fᵀ of (M, K), exactly symmetric: only one of each pair of off-diagonal blocks is computed."""
    size = len(features)
    if size <= BLOCK:
        product = features @ features.T
        return 0.5 * (product + product.T)
    out = features.new_empty((size, size))
    half = size // 2
    upper, lower = features[:half], features[half:]
    out[:half, :half], out[half:, half:] = _square(upper), _square(lower)
    out[half:, :half] = lower @ upper.T
    out[:half, half:] = out[half:, :half].T
    return out


def _add_square(a: Tensor, features: Tensor, sign: float) -> None:
    """Add sign F Fᵀ of (M, K) to the lower triangle of A, in place; of the upper one, blocks on the diagonal change."""
    if len(a) <= BLOCK:
        a.addmm_(features, features.T, alpha=sign)
        return
    half = len(a) // 2
    upper, lower = features[:half], features[half:]
    _add_square(a[:half, :half], upper, sign)
    _add_square(a[half:, half:], lower, sign)
    a[half:, :half].addmm_(lower, upper.T, alpha=sign)
