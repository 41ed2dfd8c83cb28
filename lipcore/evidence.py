"""Negative log marginal likelihood of the torques and its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi

import torch
from torch import Tensor

from lipcore.kernels.base import Params, State, TorqueKernel, row_chunks
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

    The gradient is the sum of W ∘ ∂K with W = ½ (K⁻¹ − ααᵀ), α = K⁻¹y (Rasmussen & Williams, eq. 5.9). W is a constant
    once K is factored, so ∂K is never stored: automatic differentiation runs over small chunks of pairs, and memory
    stays that of a few Gram matrices.

    motion: N samples; tau: (N, n). Raise NotPositiveDefiniteError where K cannot be factored.
    """
    n, size = kernel.n_joints, len(motion)
    factor = cholesky(noisy_gram(kernel, params, motion))
    y = tau.reshape(-1)
    alpha = factor.solve(y)
    value = 0.5 * (y @ alpha) + 0.5 * factor.log_determinant() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (torch.cholesky_inverse(factor.lower) - torch.outer(alpha, alpha))

    leaves = {name: value_.detach().clone().requires_grad_(True) for name, value_ in params.items()}
    by_sample = weight.reshape(size, n, size, n)
    for rows in row_chunks(size, size):
        # pairs below the chunk's diagonal block are the transposes of those above it, counted by the factor two
        columns = slice(rows.start, size)
        blocks = kernel.blocks(leaves, State.rows(motion[rows]), State.columns(motion[columns]))
        part = 2.0 * by_sample[rows, :, columns].permute(1, 3, 0, 2)
        part[..., : rows.stop - rows.start] *= 0.5
        torch.autograd.backward((part * blocks).sum())
    gradient = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    noise = torch.exp(2 * params["noise.log_std"])
    gradient["noise.log_std"] = 2 * noise * weight.diagonal().reshape(size, n).sum(0)
    return Evidence(float(value), gradient)
