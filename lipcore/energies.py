"""Posteriors of the kinetic and the potential energy, learnt without a label on either."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from lipcore.functionals import Estimate, condition
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.base import Params, State, row_chunks
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from lipcore.motion import Motion
from lipcore.posterior import Posterior

EnergyKernel = LipKernel | ChainKernel | ArmKernel
"""Priors of torques that come from priors of the energies."""
KINETIC, POTENTIAL = 0, 1


def kinetic_energy(posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion) -> Estimate:
    """Posterior of the kinetic energy at N queries, summed over the kernels: (N,) J."""
    mean = prior_mean(kernels, query)[KINETIC]
    variance = covariance(posterior.params, kernels, query, query)[KINETIC]
    return condition(posterior, mean, variance, with_anchors(posterior, kernels, query)[KINETIC])


def potential_energy(
    posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion, reference: Tensor
) -> Estimate:
    """Posterior of V(q) − V(reference) at N queries, summed over the kernels: (N,) J. reference: (n,).

    Torques do not tell the constant of V: only a difference has a useful uncertainty.
    """
    params, zero = posterior.params, torch.zeros_like(reference)[None]
    origin = Motion(reference[None], zero, zero)
    variance = (
        covariance(params, kernels, query, query)
        - 2 * covariance(params, kernels, query, origin)
        + covariance(params, kernels, origin, origin)
    )
    mean = prior_mean(kernels, query) - prior_mean(kernels, origin)
    cross = with_anchors(posterior, kernels, query) - with_anchors(posterior, kernels, origin)
    return condition(posterior, mean[POTENTIAL], variance[POTENTIAL], cross[POTENTIAL])


def prior_mean(kernels: Sequence[EnergyKernel], query: Motion) -> Tensor:
    """Prior means of both energies at N queries, (2, N) J."""
    total = torch.zeros((2, len(query)), dtype=torch.float64)
    for kernel in kernels:
        if isinstance(kernel, ArmKernel) and (weights := kernel.prior_weights()) is not None:
            total += (kernel.energy_features(query) @ weights).T
    return total


def covariance(params: Params, kernels: Sequence[EnergyKernel], x: Motion, y: Motion) -> Tensor:
    """Prior covariance of each energy at sample k of x with the same at sample k of y, or its only one: (2, N) J²."""
    total = torch.zeros((2, len(x)), dtype=torch.float64)
    for kernel in kernels:
        if isinstance(kernel, ArmKernel):
            scaled = kernel.energy_features(x) @ kernel.covariance(params)
            total += (scaled * kernel.energy_features(y)).sum(2).T
        else:
            total += kernel.energy_covariance(params, State.paired(x), State.paired(y))
    return total


def with_anchors(posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion) -> Tensor:
    """Prior covariance of both energies at N queries with the M anchors of the posterior: (2, M, N)."""
    total = torch.zeros((2, len(posterior.weights), len(query)), dtype=torch.float64)
    for kernel in kernels:
        if isinstance(kernel, ArmKernel):
            scaled = kernel.energy_features(query) @ kernel.covariance(posterior.params)  # (N, 2, p)
            parts = [posterior.with_weights(kernel, scaled[:, energy].T) for energy in (KINETIC, POTENTIAL)]
        else:
            anchors = posterior.with_torques(kernel, partial(_with_torques, kernel, posterior.params, query))
            parts = list(anchors.reshape(len(anchors), 2, -1).unbind(1))
        total += torch.stack(parts)
    return total


def _with_torques(kernel: LipKernel | ChainKernel, params: Params, query: Motion, motion: Motion) -> Tensor:
    """Covariance of all torques of S samples with both energies at N queries: (S n, 2 N)."""
    n, size, columns = kernel.n_joints, len(motion), State.columns(motion)
    out = torch.empty((size, n, 2, len(query)), dtype=torch.float64)
    for rows in row_chunks(len(query), size):
        cross = kernel.energies(params, State.rows(query[rows]), columns)  # (2, n, rows, S)
        out[..., rows] = cross.permute(3, 1, 0, 2)
    return out.reshape(size * n, -1)
