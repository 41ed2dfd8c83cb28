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
BELOW = 1e-5
"""How far below zero the eigenvalues of the statistics may lie by rounding without being looked at: by such a share a
variance of which samples say nothing may exceed the prior's."""
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
    """Posterior N(mean, Σ) of the M whitened variables, and what its variances are sums of, without a difference.

    root: R, (M, M) lower triangular. Its first rows R₁, of `first` variables, are what is learnt of them by who knows
    the others, I − R₁ᵀR₁ = Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁; the others R₂ are what is left of all: Σ = I₁ − R₁ᵀR₁ + R₂ᵀR₂.
    """

    mean: Tensor
    root: Tensor
    first: int = 0

    @property
    def covariance(self) -> Tensor:
        """Σ, (M, M)."""
        learnt, left = self.root[: self.first], self.root[self.first :]
        out = left.T @ left - learnt.T @ learnt
        out.diagonal()[: self.first].add_(1.0)
        return out


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


def solve(statistics: Statistics, centre: Tensor | None = None, first: int = 0) -> Solution:
    """Posterior of the whitened variables given the statistics, with the prior N(centre, I).

    Mean (I + A)⁻¹ (centre + b), covariance Σ = (I + A)⁻¹ = L⁻ᵀ L⁻¹. centre: (M,), zero where None; first: see
    `Solution`. Raise NotPositiveDefiniteError for statistics that no samples have.
    """
    right = statistics.b if centre is None else centre + statistics.b
    factor = _by_cholesky(statistics.a)
    if factor is None:
        factor = _by_eigenvalues(statistics.a)
    mean = torch.cholesky_solve(right[:, None], factor)[:, 0]
    unit = torch.eye(len(factor), dtype=factor.dtype)
    left = torch.linalg.solve_triangular(factor.T, unit[:, first:], upper=True).T
    return Solution(mean, _stacked(torch.cholesky_inverse(factor[:first, :first]), left), first)


def known(mean: Tensor, covariance: Tensor, first: int = 0) -> Solution:
    """The posterior N(mean, Σ) of whitened variables, (M,) and (M, M), as it stands; Σ is nowhere above the prior's I.

    Raise NotPositiveDefiniteError where it is.
    """
    learnt_root(covariance)
    left = _lower_root(covariance)
    given = left[:first, :first]
    return Solution(mean, _stacked(given.T @ given, left[first:]), first)


def learnt_root(covariance: Tensor) -> Tensor:
    """Q, (M, M) lower triangular, with QᵀQ = I − Σ: what is learnt of whitened variables of covariance Σ.

    Raise NotPositiveDefiniteError where Σ exceeds the prior's I.
    """
    explained = -covariance
    explained.diagonal().add_(1.0)
    return _lower_root(explained)


def _stacked(given: Tensor, left: Tensor) -> Tensor:
    """R of `Solution`. given: Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁; left: R₂."""
    first = len(given)
    if not first:
        return left.contiguous()
    out = torch.zeros((first + len(left),) * 2, dtype=left.dtype)
    out[:first, :first], out[first:] = learnt_root(given), left
    return out


def _lower_root(matrix: Tensor) -> Tensor:
    """Q, lower triangular, with QᵀQ a symmetric matrix; raise NotPositiveDefiniteError for one that is no square."""
    some = matrix.diagonal() != 0
    if not some.all():  # of others nothing is learnt, or all is known
        out = torch.zeros_like(matrix)
        out[torch.outer(some, some)] = _lower_root(matrix[some][:, some]).reshape(-1)
        return out
    # with the variables in reverse order it is Uᵀ U: the factor that is sought is the lower triangular one
    upper, failed = torch.linalg.cholesky_ex(matrix.flip(0, 1), upper=True)
    if not failed:
        lower: Tensor = upper.flip(0, 1)
        return lower
    values, vectors = torch.linalg.eigh(matrix)
    if not float(values[0]) >= -BELOW:
        raise NotPositiveDefiniteError(f"a covariance is {-float(values[0]):.3g} above the prior's or below zero")
    root = values.clamp_min(0.0).sqrt()[:, None] * vectors.T
    lower = torch.linalg.qr(root.flip(1), mode="r").R.flip(0, 1)
    return lower


def _by_cholesky(a: Tensor) -> Tensor | None:
    """L, lower triangular, with L Lᵀ = I + A; None where A is not one that samples have, to BELOW."""
    total = a.clone()
    total.diagonal().add_(BELOW)
    if torch.linalg.cholesky_ex(total).info:
        return None
    total.copy_(a).diagonal().add_(1.0)
    factor, failed = torch.linalg.cholesky_ex(total)
    return None if failed else factor


def _by_eigenvalues(a: Tensor) -> Tensor:
    """The same from any statistics, at three times the cost; raise NotPositiveDefiniteError for impossible ones."""
    values, vectors = torch.linalg.eigh(a)
    if not float(values[0]) >= -ROUNDING * max(float(values[-1]), 1.0):
        raise NotPositiveDefiniteError(
            f"statistics of size {len(values)} have the eigenvalue {float(values[0]):.3g}, expected none below zero"
        )
    root = (1 + values.clamp_min(0.0)).sqrt()[:, None] * vectors.T
    upper: Tensor = torch.linalg.qr(root, mode="r").R
    # the Cholesky factor has a positive diagonal
    return (upper * upper.diagonal().sign()[:, None]).T


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
