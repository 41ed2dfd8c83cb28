"""Statistics of a compact posterior: sums over samples, and how they are added, decayed and solved.

All functions are pure. The order of samples does not matter: fitting all samples at once, in parts, or one by one gives
the same posterior.
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

EIGENVALUE_TOLERANCE = 1e-5
"""Tolerance for negative eigenvalues of the statistics, which rounding causes. A variance may exceed the prior's by
this share if samples do not determine it."""


@dataclass(frozen=True)
class Statistics:
    """A = Σ φ R⁻¹ φᵀ, (M, M), and b = Σ φ R⁻¹ (y − E y), (M,), over samples. Each sample has weight one unless decayed.

    R is diagonal. For each torque it is the noise variance plus the variance outside the basis, k(x, x) − φᵀφ. A sample
    outside the basis therefore has little influence, instead of being explained by functions that do not reach it (the
    fully independent training conditional of Snelson & Ghahramani, 2006). samples: sum of the weights.
    """

    a: Array
    b: Array
    samples: float


@dataclass(frozen=True)
class Solution:
    """Posterior N(mean, Σ) of the M whitened variables. Its variances are sums of squares, without differences.

    root: R, (M, M) lower triangular. Its first rows R₁, of `first` variables, are the variance learnt about them if the
    others are known, I − R₁ᵀR₁ = Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁. The other rows R₂ are the remaining variance of all:
    Σ = I₁ − R₁ᵀR₁ + R₂ᵀR₂.
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
    """Return the statistics of no samples, for M = size variables."""
    return Statistics(np.zeros((size, size)), np.zeros(size), 0)


def collect(
    basis: Basis, noise_variance: Array, motion: Motion, residual: Array, weights: Array | None = None
) -> Statistics:
    """Return the sums over N samples, A = Σ φ R⁻¹ φᵀ and b = Σ φ R⁻¹ residual (eq. 24 of docs/method.md).

    noise_variance: (n,) or (N, n) (N·m)²; residual: torque minus its prior mean, (N, n) N·m; weights: (N,), one for
    each sample, None for all one.
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
    """Return the statistics of both sets of samples, from parts, streams or robots that share a basis."""
    return Statistics(one.a + other.a, one.b + other.b, one.samples + other.samples)


def add_to(statistics: Statistics, features: Array, variance: Array, residual: Array, weights: Array) -> Statistics:
    """Return the statistics with N more samples, overwriting the given ones. It is fast for few samples, often.

    Only the lower triangle of A is updated, which is all that `solve` reads; `mirror` updates the other. The result
    equals `merge` with that of `collect`, to rounding. features: φ, (M, N n), overwritten; variance: R, (N, n);
    residual: (N, n); weights: (N,).
    """
    root = np.sqrt(weights[:, None] / variance)
    features *= root.reshape(-1)
    b = features @ (residual * root).reshape(-1)
    add_square(statistics.a, features)
    return Statistics(statistics.a, statistics.b + b, statistics.samples + float(weights.sum()))


def decay(statistics: Statistics, factor: float, own: bool = False) -> Statistics:
    """Return the statistics with all sample weights multiplied by `factor`, 0 to 1. Raise ValueError for other factors.

    own: whether the given statistics may be overwritten, which gives the same bits.
    """
    if not 0.0 <= factor <= 1.0:
        raise ValueError(f"factor is {factor!r}, expected a number from 0 to 1")
    a, b = statistics.a, statistics.b
    return Statistics(np.multiply(a, factor, out=a if own else None), factor * b, factor * statistics.samples)


def copied(statistics: Statistics) -> Statistics:
    """Return a copy of the statistics."""
    return Statistics(statistics.a.copy(), statistics.b.copy(), statistics.samples)


def solve(statistics: Statistics, centre: Array | None = None, first: int = 0) -> Solution:
    """Return the posterior of the whitened variables given the statistics, with the prior N(centre, I).

    Mean (I + A)⁻¹ (centre + b), covariance Σ = (I + A)⁻¹ = L⁻ᵀ L⁻¹. centre: (M,), None for zero; first: see `Solution`.
    Raise NotPositiveDefiniteError for statistics that no samples can have.
    """
    right = statistics.b if centre is None else centre + statistics.b
    factor = _by_cholesky(statistics.a)
    if factor is None:
        factor = _by_eigenvalues(statistics.a)
    mean = solve_factored(factor, right)
    left = solve_lower_right(np.eye(len(factor))[first:], factor)
    return Solution(mean, _stacked(inverse_factored(np.ascontiguousarray(factor[:first, :first])), left), first)


def make_solution(mean: Array, covariance: Array, first: int = 0) -> Solution:
    """Return the given posterior N(mean, Σ) of whitened variables, (M,) and (M, M), as a solution.

    Raise NotPositiveDefiniteError if Σ exceeds the prior's I anywhere.
    """
    learnt_root(covariance)
    left = _lower_root(covariance)
    given = left[:first, :first]
    return Solution(mean, _stacked(given.T @ given, left[first:]), first)


def learnt_root(covariance: Array, rounding: float = 0.0) -> Array:
    """Return Q, (M, M) lower triangular, with QᵀQ = I − Σ: the variance learnt about whitened variables.

    rounding: error of Σ's eigenvalues, see `rounding_of`. Raise NotPositiveDefiniteError if Σ exceeds the prior's I.
    """
    explained = -covariance
    add_diagonal(explained, 1.0)
    return _lower_root(explained, rounding)


def rounding_of(statistics: Statistics | None) -> float:
    """Return the rounding error of A's eigenvalues: large for very many samples, or for very exact ones."""
    return 0.0 if statistics is None else float(np.finfo(np.float64).eps * np.trace(statistics.a))


def _stacked(given: Array, left: Array) -> Array:
    """Return R of `Solution`. given: Σ₁₁ − Σ₁₂ Σ₂₂⁻¹ Σ₂₁; left: R₂."""
    first = len(given)
    if not first:
        return np.ascontiguousarray(left)
    out = np.zeros((first + len(left),) * 2)
    out[:first, :first], out[first:] = learnt_root(given), left
    return out


def _lower_root(matrix: Array, rounding: float = 0.0) -> Array:
    """Return Q, lower triangular, with QᵀQ a symmetric matrix. Raise NotPositiveDefiniteError if there is none."""
    some = matrix.diagonal() != 0
    if not some.all():  # the rows of the other variables are zero
        out = np.zeros_like(matrix)
        out[np.ix_(some, some)] = _lower_root(matrix[np.ix_(some, some)], rounding)
        return out
    # with the variables in reverse order it is L Lᵀ: the required factor is Lᵀ, reversed
    root = lower_root(matrix[::-1, ::-1])
    if root is not None:
        return np.ascontiguousarray(root.T[::-1, ::-1])
    values, vectors = eigen(matrix)
    if not float(values[0]) >= -(EIGENVALUE_TOLERANCE + rounding):
        raise NotPositiveDefiniteError(f"a covariance is {-float(values[0]):.3g} above the prior's or below zero")
    root = np.sqrt(values.clip(0.0))[:, None] * vectors.T
    return np.ascontiguousarray(_upper(root[:, ::-1])[::-1, ::-1])


def _by_cholesky(a: Array) -> Array | None:
    """Return L, lower triangular, with L Lᵀ = I + A, or None if A has eigenvalues below −EIGENVALUE_TOLERANCE."""
    return None if lower_root(a, EIGENVALUE_TOLERANCE) is None else lower_root(a, 1.0)


def _by_eigenvalues(a: Array) -> Array:
    """Return the same for any statistics, at three times the cost.

    Raise NotPositiveDefiniteError for impossible ones.
    """
    values, vectors = eigen(a)
    if not float(values[0]) >= -1e-8 * max(float(values[-1]), 1.0):  # less is rounding
        raise NotPositiveDefiniteError(
            f"statistics of size {len(values)} have the eigenvalue {float(values[0]):.3g}, expected none below zero"
        )
    root = np.sqrt(1 + values.clip(0.0))[:, None] * vectors.T
    upper = _upper(root)
    # a Cholesky factor has a positive diagonal
    return np.ascontiguousarray((upper * np.sign(upper.diagonal())[:, None]).T)


def _upper(matrix: Array) -> Array:
    """Return R of the QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))
