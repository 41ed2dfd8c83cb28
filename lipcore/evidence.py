"""Negative log marginal likelihood of the torques and its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi

import torch
from torch import Tensor

from lipcore.kernels.base import Params, TorqueKernel
from lipcore.linalg import cholesky
from lipcore.motion import Motion
from lipcore.posterior import noisy_gram


@dataclass(frozen=True)
class Evidence:
    """value: −log p(tau | hyperparameters) in nats; gradient: its derivative by each hyperparameter."""

    value: float
    gradient: dict[str, Tensor]


def negative_log_evidence(kernel: TorqueKernel, params: Params, motion: Motion, tau: Tensor) -> Evidence:
    """½ yᵀK⁻¹y + ½ log det K + ½ N n log 2π with K = k(X, X) + R, and its gradient.

    The gradient is the sum of W ∘ ∂K with W = ½ (K⁻¹ − ααᵀ), α = K⁻¹y (Rasmussen & Williams, eq. 5.9); y is what the
    prior mean leaves. W is a constant once K is factored, so each kernel differentiates Σ W ∘ K in its own way.

    motion: N samples; tau: (N, n). Raise NotPositiveDefiniteError where K cannot be factored.
    """
    n, size = kernel.n_joints, len(motion)
    factor = cholesky(noisy_gram(kernel, params, motion))
    y = (tau - kernel.mean(motion)).reshape(-1)
    alpha = factor.solve(y)
    value = 0.5 * (y @ alpha) + 0.5 * factor.log_determinant() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (torch.cholesky_inverse(factor.lower) - torch.outer(alpha, alpha))
    gradient = kernel.gradient(params, motion, weight)
    noise = torch.exp(2 * params["noise.log_std"])
    gradient["noise.log_std"] = 2 * noise * weight.diagonal().reshape(size, n).sum(0)
    return Evidence(float(value), gradient)
