"""What the learnt energies say beyond torque: inertia matrix, gravity, kinetic and potential energy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.kernels.base import State
from lipcore.kernels.lip import LipKernel
from lipcore.motion import Motion
from lipcore.posterior import ExactPosterior


@dataclass(frozen=True)
class Energies:
    """Posterior means in J, each (N,). The potential is known up to a constant."""

    kinetic: Tensor
    potential: Tensor


def inertia_matrix(posterior: ExactPosterior, dynamics: LipKernel, q: Tensor) -> Tensor:
    """Posterior mean of M(q), (N, n, n): the torque per unit acceleration, exact since torque is affine in ddq."""
    n = q.shape[1]
    zero = torch.zeros_like(q)
    rest = posterior.mean(Motion(q, zero, zero), dynamics)
    columns = []
    for joint in range(n):
        push = zero.clone()
        push[:, joint] = 1.0
        columns.append(posterior.mean(Motion(q, zero, push), dynamics) - rest)
    return torch.stack(columns, dim=2)


def gravity(posterior: ExactPosterior, dynamics: LipKernel, q: Tensor) -> Tensor:
    """Posterior mean of the gravity torque g(q), (N, n) N·m: the torque at standstill, friction excluded."""
    zero = torch.zeros_like(q)
    return posterior.mean(Motion(q, zero, zero), dynamics)


def energies(posterior: ExactPosterior, dynamics: LipKernel, query: Motion) -> Energies:
    """Posterior means of kinetic and potential energy, learnt without a label on either."""
    cross = dynamics.energies(posterior.params, State.rows(query), State.columns(posterior.motion))
    weights = posterior.weights.reshape(-1, query.n_joints).T[:, None, :]
    kinetic, potential = (cross * weights).sum((1, 3))
    return Energies(kinetic, potential)
