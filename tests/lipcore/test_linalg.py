"""Cholesky factors and the jitter policy."""

from __future__ import annotations

import pytest
import torch

from lipcore.posterior.linalg import NotPositiveDefiniteError, cholesky


def well_conditioned(size: int) -> torch.Tensor:
    root = torch.randn(size, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return root @ root.T + torch.eye(size, dtype=torch.float64)


def test_factor_solves_whitens_and_has_the_log_determinant() -> None:
    matrix = well_conditioned(6)
    factor, right = cholesky(matrix), well_conditioned(6)[:, :2]
    assert factor.jitter == 0
    assert torch.allclose(matrix @ factor.solve(right), right, rtol=0, atol=1e-12)
    assert torch.allclose(factor.solve(right[:, 0]), factor.solve(right)[:, 0], rtol=0, atol=1e-14)
    white = factor.whiten(right)
    assert torch.allclose(white.T @ white, right.T @ torch.linalg.inv(matrix) @ right, rtol=1e-10, atol=0)
    assert torch.allclose(factor.log_determinant(), torch.linalg.slogdet(matrix).logabsdet, rtol=1e-12, atol=0)


@pytest.mark.parametrize("jitter", [1e-12, 1e-11, 1e-10, 1e-9, 1e-8])
def test_smallest_jitter_that_works_is_taken_and_reported(jitter: float) -> None:
    matrix = torch.diag(torch.tensor([2.0, 4.0, 6.0, 0.0]).double())
    # off by half of what this jitter adds, five times what the one before it adds
    matrix[3, 3] = -0.5 * jitter * 3.0
    factor = cholesky(matrix)
    assert factor.jitter == pytest.approx(jitter * 3.0, rel=1e-6)
    shifted = matrix + factor.jitter * torch.eye(4, dtype=torch.float64)
    assert torch.allclose(factor.lower @ factor.lower.T, shifted, rtol=1e-12, atol=1e-25)


def test_singular_matrix_takes_little_jitter() -> None:
    factor = cholesky(torch.ones(4, 4, dtype=torch.float64))
    assert 0 < factor.jitter <= 1e-11


def test_indefinite_matrix_is_refused() -> None:
    matrix = torch.diag(torch.tensor([1.0, 1.0, -1e-6]).double())
    with pytest.raises(NotPositiveDefiniteError, match="size 3 is not positive definite"):
        cholesky(matrix)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_matrix_that_is_not_finite_is_refused(value: float) -> None:
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[2, 1] = value
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        cholesky(matrix)
