"""What a compact posterior needs to know of the data: sums over samples, and how they are added, aged and solved.

All functions are pure. Sums know no order: fitting all samples at once, or in parts, or one by one, gives the same
posterior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.posterior.basis import Basis
from lipcore.posterior.linalg import (
    NotPositiveDefiniteError,
    add_diagonal,
    add_square,
    eigen,
    inverse_factored,
    lower_root,
    mirror,
    solve_factored,
    solve_lower_right,
)

BELOW = 1e-5
"""How far below zero the eigenvalues of the statistics may lie by rounding without being looked at: by such a share a
variance of which samples say nothing may exceed the prior's."""


@dataclass(frozen=True)
class Statistics:
    """A = Σ φ R⁻¹ φᵀ, (M, M), and b = Σ φ R⁻¹ (y − E y), (M,), over samples, each with a weight of one unless aged.

    R: diagonal; of each torque the noise variance and what the basis leaves open, k(x, x) − φᵀφ. So a sample beyond the
    basis teaches the little that it can, instead of being explained by functions that do not reach it (the fully
    independent training conditional of Snelson & Ghahramani, 2006). samples: sum of the weights.
    """

    a: Array
    b: Array
    samples: float


@dataclass(frozen=True)
class Solution:
    """Posterior N(mean, Σ) of the M whitened variables, and what its variances are sums of, without a difference.

    root: R, (M, M) lower triangular. Its first rows R₁, of `first` variables, are what is learnt of them by who knows
    the others, I − R₁ᵀR₁ = Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁; the others R₂ are what is left of all: Σ = I₁ − R₁ᵀR₁ + R₂ᵀR₂.
    """

    mean: Array
    root: Array
    first: int = 0

    @property
    def covariance(self) -> Array:
        """Σ, (M, M)."""
        learnt, left = self.root[: self.first], self.root[self.first :]
        out = left.T @ left - learnt.T @ learnt
        add_diagonal(out[: self.first, : self.first], 1.0)
        return out


def empty(size: int) -> Statistics:
    """Statistics of no samples, for M = size variables."""
    return Statistics(np.zeros((size, size)), np.zeros(size), 0)


def collect(
    basis: Basis, noise_variance: Array, motion: Motion, residual: Array, weights: Array | None = None
) -> Statistics:
    """Sums over N samples, A = Σ φ R⁻¹ φᵀ and b = Σ φ R⁻¹ residual (eq. 24 of docs/method.md).

    noise_variance: (n,) or (N, n) (N·m)²; residual: torque less its prior mean, (N, n) N·m; weights: (N,),
    what each sample counts, one where None.
    """
    features = basis.features(motion)
    variance = noise_variance + basis.uncovered(motion, features)
    root = np.sqrt((1.0 if weights is None else weights[:, None]) / variance)
    features *= root.reshape(-1)
    b = features @ (residual * root).reshape(-1)
    a = np.zeros((len(features),) * 2)
    add_square(a, features)
    mirror(a)
    return Statistics(a, b, float(len(motion) if weights is None else weights.sum()))


def merge(one: Statistics, other: Statistics) -> Statistics:
    """Statistics of the samples of both, from parts, streams or robots that share a basis."""
    return Statistics(one.a + other.a, one.b + other.b, one.samples + other.samples)


def add_to(statistics: Statistics, features: Array, variance: Array, residual: Array, weights: Array) -> Statistics:
    """Statistics with N samples more, that overwrite these: for few samples, often.

    Of A only the lower triangle is kept up, which is all that `solve` reads; `mirror` follows with the other. The same
    to rounding as to `merge` what `collect` finds. features: φ, (M, N n), overwritten; variance: R, (N, n); residual:
    (N, n); weights: (N,).
    """
    root = np.sqrt(weights[:, None] / variance)
    features *= root.reshape(-1)
    b = features @ (residual * root).reshape(-1)
    add_square(statistics.a, features)
    return Statistics(statistics.a, statistics.b + b, statistics.samples + float(weights.sum()))


def decay(statistics: Statistics, factor: float, own: bool = False) -> Statistics:
    """Statistics whose samples count a `factor` from 0 to 1 as much as before; raise ValueError for another.

    own: whether these are not needed any more and may be overwritten, to the same bits.
    """
    if not 0.0 <= factor <= 1.0:
        raise ValueError(f"factor is {factor!r}, expected a number from 0 to 1")
    a, b = statistics.a, statistics.b
    return Statistics(np.multiply(a, factor, out=a if own else None), factor * b, factor * statistics.samples)


def copied(statistics: Statistics) -> Statistics:
    """The same statistics in memory of their own."""
    return Statistics(statistics.a.copy(), statistics.b.copy(), statistics.samples)


def solve(statistics: Statistics, centre: Array | None = None, first: int = 0) -> Solution:
    """Posterior of the whitened variables given the statistics, with the prior N(centre, I).

    Mean (I + A)⁻¹ (centre + b), covariance Σ = (I + A)⁻¹ = L⁻ᵀ L⁻¹. centre: (M,), zero where None; first: see
    `Solution`. Raise NotPositiveDefiniteError for statistics that no samples have.
    """
    right = statistics.b if centre is None else centre + statistics.b
    factor = _by_cholesky(statistics.a)
    if factor is None:
        factor = _by_eigenvalues(statistics.a)
    mean = solve_factored(factor, right)
    left = solve_lower_right(np.eye(len(factor))[first:], factor)
    return Solution(mean, _stacked(inverse_factored(np.ascontiguousarray(factor[:first, :first])), left), first)


def known(mean: Array, covariance: Array, first: int = 0) -> Solution:
    """The posterior N(mean, Σ) of whitened variables, (M,) and (M, M), as it stands; Σ is nowhere above the prior's I.

    Raise NotPositiveDefiniteError where it is.
    """
    learnt_root(covariance)
    left = _lower_root(covariance)
    given = left[:first, :first]
    return Solution(mean, _stacked(given.T @ given, left[first:]), first)


def learnt_root(covariance: Array) -> Array:
    """Q, (M, M) lower triangular, with QᵀQ = I − Σ: what is learnt of whitened variables of covariance Σ.

    Raise NotPositiveDefiniteError where Σ exceeds the prior's I.
    """
    explained = -covariance
    add_diagonal(explained, 1.0)
    return _lower_root(explained)


def _stacked(given: Array, left: Array) -> Array:
    """R of `Solution`. given: Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁; left: R₂."""
    first = len(given)
    if not first:
        return np.ascontiguousarray(left)
    out = np.zeros((first + len(left),) * 2)
    out[:first, :first], out[first:] = learnt_root(given), left
    return out


def _lower_root(matrix: Array) -> Array:
    """Q, lower triangular, with QᵀQ a symmetric matrix; raise NotPositiveDefiniteError for one that is no square."""
    some = matrix.diagonal() != 0
    if not some.all():  # of others nothing is learnt, or all is known
        out = np.zeros_like(matrix)
        out[np.ix_(some, some)] = _lower_root(matrix[np.ix_(some, some)])
        return out
    # with the variables in reverse order it is L Lᵀ: the factor that is sought is Lᵀ, reversed
    root = lower_root(matrix[::-1, ::-1])
    if root is not None:
        return np.ascontiguousarray(root.T[::-1, ::-1])
    values, vectors = eigen(matrix)
    if not float(values[0]) >= -BELOW:
        raise NotPositiveDefiniteError(f"a covariance is {-float(values[0]):.3g} above the prior's or below zero")
    root = np.sqrt(values.clip(0.0))[:, None] * vectors.T
    return np.ascontiguousarray(_upper(root[:, ::-1])[::-1, ::-1])


def _by_cholesky(a: Array) -> Array | None:
    """L, lower triangular, with L Lᵀ = I + A; None where A is not one that samples have, to BELOW."""
    return None if lower_root(a, BELOW) is None else lower_root(a, 1.0)


def _by_eigenvalues(a: Array) -> Array:
    """The same from any statistics, at three times the cost; raise NotPositiveDefiniteError for impossible ones."""
    values, vectors = eigen(a)
    if not float(values[0]) >= -1e-8 * max(float(values[-1]), 1.0):  # less is rounding
        raise NotPositiveDefiniteError(
            f"statistics of size {len(values)} have the eigenvalue {float(values[0]):.3g}, expected none below zero"
        )
    root = np.sqrt(1 + values.clip(0.0))[:, None] * vectors.T
    upper = _upper(root)
    # the Cholesky factor has a positive diagonal
    return np.ascontiguousarray((upper * np.sign(upper.diagonal())[:, None]).T)


def _upper(matrix: Array) -> Array:
    """R of the QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))
