"""What a compact posterior needs to know of the data: sums over samples."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from lipcore.compact.basis import Basis
from lipcore.motion import Motion


@dataclass(frozen=True)
class Statistics:
    """A = Σ φ R⁻¹ φᵀ, (M, M), and b = Σ φ R⁻¹ (y − E y), (M,), over `samples` samples with noise variances R."""

    a: Tensor
    b: Tensor
    samples: int

    @classmethod
    def collect(cls, basis: Basis, noise_variance: Tensor, motion: Motion, residual: Tensor) -> Statistics:
        """Sum over N samples. noise_variance: (n,); residual: torque less its prior mean, (N, n)."""
        precision = noise_variance.rsqrt().repeat(len(motion))
        features = basis.features(motion) * precision
        return cls(_symmetric(features @ features.T), features @ (residual.reshape(-1) * precision), len(motion))


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.T)
