"""Cholesky factors, the project's only jitter policy, and symmetric matrices stored as triangles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

JITTERS = (0.0, 1e-12, 1e-11, 1e-10, 1e-9, 1e-8)
"""Diagonal added, relative to the mean diagonal, tried in this order."""


class NotPositiveDefiniteError(ArithmeticError):
    """A covariance matrix is not positive definite even with the largest jitter of the policy."""


@dataclass(frozen=True)
class Factor:
    """Lower Cholesky factor L of K + jitter·I: `lower` (m, m) and the absolute jitter that it took."""

    lower: Tensor
    jitter: float

    def solve(self, right: Tensor) -> Tensor:
        """K⁻¹ right for right of shape (m,) or (m, k)."""
        columns = right[:, None] if right.dim() == 1 else right
        solved: Tensor = torch.cholesky_solve(columns, self.lower)
        return solved.reshape(right.shape)

    def whiten(self, right: Tensor) -> Tensor:
        """L⁻¹ right for right of shape (m, k)."""
        solved: Tensor = torch.linalg.solve_triangular(self.lower, right, upper=False)
        return solved

    def log_determinant(self) -> Tensor:
        """log det K."""
        return self.lower.diagonal().log().sum().mul(2)


def cholesky(matrix: Tensor) -> Factor:
    """Factor a symmetric positive definite matrix; raise NotPositiveDefiniteError where the jitter policy fails."""
    if not torch.isfinite(matrix).all():
        raise NotPositiveDefiniteError("the covariance matrix holds a value that is not finite")
    scale = matrix.diagonal().mean()
    for relative in JITTERS:
        jitter = relative * float(scale)
        shifted = (
            matrix
            if relative == 0.0
            else matrix + jitter * torch.eye(matrix.shape[0], dtype=matrix.dtype, device=matrix.device)
        )
        lower, info = torch.linalg.cholesky_ex(shifted)
        if int(info) == 0:
            return Factor(lower, jitter)
    raise NotPositiveDefiniteError(
        f"covariance matrix of size {matrix.shape[0]} is not positive definite: "
        f"a jitter of {JITTERS[-1]:g} times its mean diagonal {float(scale):.3g} did not help"
    )


def pack_symmetric(symmetric: Tensor) -> Tensor:
    """Upper triangle of a symmetric matrix (M, M), row by row: (M (M + 1) / 2,)."""
    rows, columns = torch.triu_indices(*symmetric.shape)
    return symmetric[rows, columns]


def unpack_symmetric(name: str, packed: Tensor) -> Tensor:
    """The symmetric matrix (M, M) of `pack_symmetric`; name: of the tensor, for the message.

    Raise ValueError for a length that no triangle has.
    """
    size = math.isqrt(2 * packed.numel())
    if packed.dim() != 1 or size * (size + 1) // 2 != len(packed):
        raise ValueError(f"{name} has shape {tuple(packed.shape)}, expected M (M + 1) / 2 numbers")
    rows, columns = torch.triu_indices(size, size)
    full = torch.empty((size, size), dtype=packed.dtype)
    full[rows, columns] = full[columns, rows] = packed
    return full
