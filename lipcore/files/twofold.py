"""Matrices to twice the digits of float64: pairs of arrays (high, low) whose sum is meant (Dekker 1971).

What samples leave of a prior variance may be 1e-10 of it. As a difference of float64 that has six digits; a difference
of these, and its Cholesky root, have all sixteen. Each step is one of NumPy's over a whole matrix, without the GIL.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.samples import Array

SPLIT = 2.0**27 + 1.0


@dataclass(frozen=True)
class Twofold:
    """A matrix: high, low: (r, c), |low| at most half a unit in the last place of high."""

    high: Array
    low: Array

    @classmethod
    def of(cls, values: Array) -> Twofold:
        """A matrix of float64."""
        return cls(values, np.zeros_like(values))

    @property
    def T(self) -> Twofold:  # noqa: N802 - as NumPy has it
        """Its transpose."""
        return Twofold(self.high.T, self.low.T)

    def __sub__(self, other: Twofold) -> Twofold:
        high, rest = _sum(self.high, -other.high)
        return _normal(high, rest + self.low - other.low)

    def __mul__(self, other: Twofold) -> Twofold:
        """Elementwise, of shapes that broadcast."""
        high, rest = _product(self.high, other.high)
        return _normal(high, rest + self.high * other.low + self.low * other.high)

    def __matmul__(self, other: Twofold) -> Twofold:
        total = Twofold.of(np.zeros((len(self.high), other.high.shape[1])))
        for k in range(len(other.high)):
            total = total - self[:, k : k + 1] * -other[k : k + 1]
        return total

    def __neg__(self) -> Twofold:
        return Twofold(-self.high, -self.low)

    def __getitem__(self, places: slice | tuple[slice, slice]) -> Twofold:
        return Twofold(self.high[places], self.low[places])

    def sums(self) -> Twofold:
        """Sum of each row, (r, 1)."""
        return self @ Twofold.of(np.ones((self.high.shape[1], 1)))


def upper_root(matrix: Twofold) -> Array:
    """U, (r, r) upper triangular, with U Uᵀ = matrix, symmetric. Raise ValueError where it is not positive definite."""
    root = np.zeros_like(matrix.high)
    for k in range(len(root) - 1, -1, -1):
        corner = matrix[k : k + 1, k : k + 1]
        if not corner.high[0, 0] > 0:
            raise ValueError(f"the posterior covariance is not positive definite to rounding, at {k} of {len(root)}")
        # one step of Newton's makes the float64 reciprocal root a twofold one
        guess = Twofold.of(1.0 / np.sqrt(corner.high))
        off = Twofold.of(np.ones((1, 1))) - corner * (guess * guess)
        scale = guess - -(guess * Twofold.of(0.5 * off.high))
        column = matrix[:, k : k + 1] * scale
        root[: k + 1, k] = column.high[: k + 1, 0]
        matrix = matrix[:k, :k] - column[:k] * column[:k].T
    return root


def _sum(a: Array, b: Array) -> tuple[Array, Array]:
    """a + b and what rounding leaves of it, exactly."""
    total = a + b
    of_b = total - a
    return total, (a - (total - of_b)) + (b - of_b)


def _product(a: Array, b: Array) -> tuple[Array, Array]:
    """a b and what rounding leaves of it, exactly."""
    total = a * b
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    return total, ((a_high * b_high - total) + a_high * b_low + a_low * b_high) + a_low * b_low


def _halves(a: Array) -> tuple[Array, Array]:
    big = SPLIT * a
    high = big - (big - a)
    return high, a - high


def _normal(high: Array, low: Array) -> Twofold:
    total = high + low
    return Twofold(total, low - (total - high))
