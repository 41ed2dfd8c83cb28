"""Triangular linear algebra, the project's only jitter policy, and symmetric matrices stored as triangles.

LAPACK and BLAS of SciPy read arrays in Fortran order. In memory, a lower triangular L in C order is the upper
triangular Lᵀ in Fortran order. Every routine is called with Lᵀ, and nothing is copied into another order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, eigh, lapack

from lipcore.data.motion import Array

JITTERS = (0.0, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8)
"""Values added to the diagonal, relative to its mean, in the order of the attempts."""
Real = TypeVar("Real", np.float64, np.float32)
_blas, _lapack = cast(Any, blas), cast(Any, lapack)  # f2py modules have no types


class NotPositiveDefiniteError(ArithmeticError):
    """A covariance matrix is not positive definite, even with the largest jitter of the policy."""


@dataclass(frozen=True)
class Factor:
    """Lower Cholesky factor L of K + jitter·I, (m, m), and the absolute jitter."""

    lower: Array
    jitter: float

    def solve(self, right: Array) -> Array:
        """Return K⁻¹ right for right of shape (m,) or (m, k)."""
        return solve_factored(self.lower, right)

    def whiten(self, right: Array) -> Array:
        """Return L⁻¹ right for right of shape (m,) or (m, k)."""
        return solve_lower(self.lower, right)

    def inverse(self) -> Array:
        """Return K⁻¹, (m, m), exactly symmetric."""
        return inverse_factored(self.lower)

    def log_determinant(self) -> float:
        """Return log det K."""
        return 2 * float(np.log(self.lower.diagonal()).sum())


def cholesky(matrix: Array) -> Factor:
    """Return the Cholesky factor of a symmetric matrix. Raise NotPositiveDefiniteError if the jitter policy fails."""
    if not np.isfinite(matrix).all():
        raise NotPositiveDefiniteError("the covariance matrix contains a value that is not finite")
    scale = float(matrix.diagonal().mean()) if len(matrix) else 0.0
    for relative in JITTERS:
        lower = lower_root(matrix, relative * scale)
        if lower is not None:
            return Factor(lower, relative * scale)
    raise NotPositiveDefiniteError(
        f"covariance matrix of size {len(matrix)} is not positive definite: "
        f"a jitter of {JITTERS[-1]:g} times its mean diagonal {scale:.3g} did not help"
    )


def lower_root(matrix: Array, added: float = 0.0) -> Array | None:
    """Return L, (m, m) lower triangular, with L Lᵀ = matrix + added·I, or None if that is not positive definite.

    The matrix is read from its lower triangle.
    """
    own = np.array(matrix, order="C")
    if not len(own):
        return own
    add_diagonal(own, added)
    upper, failed = _lapack.dpotrf(own.T, lower=0, clean=1, overwrite_a=1)
    return None if failed else upper.T


def solve_lower(lower: Array, right: Array, transposed: bool = False) -> Array:
    """Return L⁻¹ right, or L⁻ᵀ right. lower: (m, m) in C order; right: (m,) or (m, k)."""
    if not right.size:
        return right.copy()
    if right.ndim == 1:
        return np.asarray(_blas.dtrsv(lower.T, right, lower=0, trans=0 if transposed else 1))
    # the call computes the transpose: Xᵀ = Bᵀ L⁻ᵀ
    solved = _blas.dtrsm(1.0, lower.T, right.T, side=1, lower=0, trans_a=1 if transposed else 0)
    return np.asarray(solved.T)


def solve_lower_right(left: Array, lower: Array) -> Array:
    """Return left L⁻¹. left: (k, m); lower: (m, m)."""
    return solve_lower(lower, left.T, transposed=True).T


def whiten_rows(lower: NDArray[Real], rows: NDArray[Real]) -> None:
    """Overwrite each row x of `rows`, (K, m), by L⁻¹ x. Both are of float64 or float32 numbers; rows: in C order."""
    if not rows.flags.c_contiguous or lower.dtype != rows.dtype:
        raise ValueError("rows are not C-contiguous or of another type, expected an array that BLAS can write to")
    if rows.size:
        solve = _blas.dtrsm if rows.dtype == np.float64 else _blas.strsm
        solve(1.0, lower.T, rows.T, side=0, lower=0, trans_a=1, overwrite_b=1)


def solve_factored(lower: Array, right: Array) -> Array:
    """Return (L Lᵀ)⁻¹ right. lower: (m, m); right: (m,) or (m, k)."""
    return solve_lower(lower, solve_lower(lower, right), transposed=True)


def inverse_factored(lower: Array) -> Array:
    """Return (L Lᵀ)⁻¹, (m, m), exactly symmetric."""
    if not len(lower):
        return lower.copy()
    upper, failed = _lapack.dpotri(lower.T, lower=0)
    if failed:
        raise NotPositiveDefiniteError("a Cholesky factor has a zero on its diagonal")
    inverse = np.asarray(upper.T)
    mirror(inverse)
    return inverse


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Return the eigenvalues of a symmetric matrix, (m,), ascending, and its eigenvectors, the columns of (m, m).

    Divide and conquer does not converge for every matrix. QR iterations, which are slower, are the fallback. The matrix
    is read from its lower triangle. Raise NotPositiveDefiniteError for a number that is not finite.
    """
    if not np.isfinite(matrix).all():
        raise NotPositiveDefiniteError("a symmetric matrix contains a number that is not finite")
    try:
        values, vectors = np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        values, vectors = eigh(matrix, driver="ev")
    return values, vectors


def add_diagonal(matrix: Array, values: Array | float) -> None:
    """Add to the diagonal of a square matrix, in place. values: (m,), or one for all."""
    np.einsum("ii->i", matrix)[:] += values


def add_square(a: Array, features: Array) -> None:
    """Add F Fᵀ to the lower triangle of A, in place. a: (M, M); features: F, (M, K); both in C order."""
    if not (a.flags.c_contiguous and features.flags.c_contiguous):
        raise ValueError("a and features are not both C-contiguous, expected arrays that BLAS can write to in place")
    if features.size:
        _blas.dsyrk(1.0, features.T, beta=1.0, c=a.T, trans=1, lower=0, overwrite_c=1)


def add_square_of_rows(a: Array, rows: Array) -> None:
    """Add RᵀR to the upper triangle of A, in place. a: (M, M); rows: R, (K, M); both in C order."""
    if not (a.flags.c_contiguous and rows.flags.c_contiguous):
        raise ValueError("a and rows are not both C-contiguous, expected arrays that BLAS can write to in place")
    if rows.size:
        _blas.dsyrk(1.0, rows.T, beta=1.0, c=a.T, trans=0, lower=1, overwrite_c=1)


def mirror(a: Array) -> None:
    """Make the upper triangle of a square matrix equal to the lower one, in place."""
    np.copyto(a, a.T, where=np.tri(len(a), k=-1, dtype=bool).T)


def block_diagonal(blocks: list[Array]) -> Array:
    """Return a matrix with square blocks along its diagonal and zeros elsewhere."""
    size = sum(map(len, blocks))
    out, at = np.zeros((size, size)), 0
    for block in blocks:
        out[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return out


def pack_symmetric(symmetric: Array) -> Array:
    """Return the upper triangle of a symmetric matrix (M, M), row by row, (M (M + 1) / 2,)."""
    return np.asarray(symmetric[np.triu_indices(len(symmetric))])


def unpack_symmetric(name: str, packed: Array) -> Array:
    """Return the symmetric matrix (M, M) of `pack_symmetric`. name: of the tensor, for the error message.

    Raise ValueError if no triangle has this length.
    """
    size = math.isqrt(2 * packed.size)
    if packed.ndim != 1 or size * (size + 1) // 2 != len(packed):
        raise ValueError(f"{name} has shape {packed.shape}, expected M (M + 1) / 2 numbers")
    rows, columns = np.triu_indices(size)
    full = np.empty((size, size))
    full[rows, columns] = full[columns, rows] = packed
    return full
