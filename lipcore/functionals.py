"""Posteriors of what is jointly Gaussian with the torques: their sums and differences, and the energies behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.kernels.base import TorqueKernel
from lipcore.motion import Motion
from lipcore.posterior import Posterior

COLUMNS_PER_CHUNK = 512
"""Right-hand sides whitened together: enough for fast matrix products, few enough to stay within tens of MB."""


@dataclass(frozen=True)
class Estimate:
    """Posterior mean and standard deviation of a quantity at N queries, both (N, ...), noise excluded."""

    mean: Tensor
    std: Tensor


def condition(posterior: Posterior, prior_mean: Tensor, prior_variance: Tensor, cross: Tensor) -> Estimate:
    """Posterior of K quantities from their covariance with the posterior's anchors (see `Posterior`).

    prior_mean, prior_variance: (K,); cross: (M, K).
    """
    explained = posterior.whiten(cross).square().sum(0)
    std = (prior_variance - explained).clamp_min(0.0).sqrt()  # rounding may end below zero where all is known
    return Estimate(prior_mean + posterior.weights @ cross, posterior.std_factor * std)


def combine_torques(
    posterior: Posterior, kernel: TorqueKernel, motions: Sequence[Motion], coefficients: Tensor
) -> Estimate:
    """Posterior of F linear combinations of a kernel's torques at S motions a query, (N, F).

    The joint posterior of all S n torques is used: what they share cancels in a difference, in its uncertainty too.
    motions: S motions of N queries each; coefficients: (F, S n), motion by motion.
    """
    n, size, count = kernel.n_joints, len(motions), len(motions[0])
    stacked = [torch.stack([getattr(m, name) for m in motions], dim=1) for name in ("q", "dq", "ddq")]  # (N, S, n)
    step = max(1, COLUMNS_PER_CHUNK // (size * n))
    means, stds = [], []
    for start in range(0, count, step):
        stack = Motion(*(part[start : start + step].reshape(-1, n) for part in stacked))
        queries = len(stack) // size
        cross = posterior.cross(kernel, stack)  # (M, queries S n)
        cross = cross.reshape(-1, size * n) @ coefficients.T
        grams = [kernel.symmetric_gram(posterior.params, stack[k * size : (k + 1) * size]) for k in range(queries)]
        variance = torch.stack([(coefficients @ gram * coefficients).sum(1) for gram in grams])
        mean = kernel.mean(stack).reshape(queries, -1) @ coefficients.T
        found = condition(posterior, mean.reshape(-1), variance.reshape(-1), cross.reshape(len(posterior.weights), -1))
        means.append(found.mean.reshape(queries, -1))
        stds.append(found.std.reshape(queries, -1))
    return Estimate(torch.cat(means), torch.cat(stds))
