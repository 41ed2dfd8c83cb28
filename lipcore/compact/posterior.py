"""The compact posterior: a Gaussian over M basis functions, made of sums over samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.compact.basis import Basis
from lipcore.compact.statistics import Statistics
from lipcore.kernels.base import LinearKernel, TorqueKernel
from lipcore.linalg import NotPositiveDefiniteError
from lipcore.motion import Motion
from lipcore.posterior import Posterior

ROUNDING = 1e-8
"""Share of the largest eigenvalue of the statistics by which the smallest may lie below zero."""


@dataclass(frozen=True)
class CompactPosterior(Posterior):
    """Posterior whose anchors are the M variables of a basis (DESIGN §4).

    The whitened variables have the posterior N((I + A)⁻¹ b, (I + A)⁻¹). With c = cov(u, f(x)) = B φ(x):

        mean       E f(x) + φᵀ (I + A)⁻¹ b                    = E f(x) + cᵀ α,     α = B⁻ᵀ (I + A)⁻¹ b
        variance   k(x, x) − φᵀφ + φᵀ (I + A)⁻¹ φ             = k(x, x) − |Q c|²,  QᵀQ = B⁻ᵀ (I − (I + A)⁻¹) B⁻¹

    where φ does not reach, the variance is the prior's. root: Q, (M, M) upper triangular; noise_variance: (n,) R.
    """

    basis: Basis
    statistics: Statistics
    noise_variance: Tensor
    root: Tensor

    @classmethod
    def build(
        cls,
        kernel: TorqueKernel,
        basis: Basis,
        statistics: Statistics,
        noise_variance: Tensor,
        std_factor: float = 1.0,
    ) -> CompactPosterior:
        """Posterior of statistics; raise NotPositiveDefiniteError for such as no samples have."""
        values, vectors = torch.linalg.eigh(statistics.a)
        if not float(values[0]) >= -ROUNDING * float(values[-1]):
            raise NotPositiveDefiniteError(
                f"statistics of size {len(values)} have the eigenvalue {float(values[0]):.3g}, expected none below zero"
            )
        values = values.clamp_min(0.0)
        mean = vectors @ ((vectors.T @ statistics.b) / (1 + values))
        weights = torch.linalg.solve_triangular(basis.root.T, mean[:, None], upper=True)[:, 0]
        learnt = (values / (1 + values)).sqrt()[:, None] * vectors.T  # its square is I − (I + A)⁻¹
        # triangular, by QR and not from QᵀQ itself: B⁻¹ is badly conditioned
        root = torch.linalg.qr(torch.linalg.solve_triangular(basis.root, learnt, upper=False, left=False), mode="r").R
        return cls(kernel, basis.params, std_factor, weights, basis, statistics, noise_variance, root)

    def whiten(self, cross: Tensor) -> Tensor:
        """Q c."""
        return self.root @ cross

    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Tensor]) -> Tensor:
        """Covariance of the inducing torques with K quantities, zero for the linear terms' weights."""
        if term is not self.basis.term:
            raise ValueError("the term is none of this posterior")
        inducing = covariance(self.basis.inducing)[self.basis.outputs]
        return torch.cat([inducing, inducing.new_zeros((len(self.basis) - len(inducing), inducing.shape[1]))])

    def with_weights(self, term: LinearKernel, covariance: Tensor) -> Tensor:
        """Covariance of the linear term's weights with K quantities, zero for all other variables."""
        out = covariance.new_zeros((len(self.basis), covariance.shape[1]))
        out[self.basis.rows(term)] = covariance
        return out
