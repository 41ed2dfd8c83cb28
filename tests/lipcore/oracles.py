"""Slow, independent references: the definition, differentiated by machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Energy = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""k(q, v, q', v') of one energy, scalar."""


def base_kernel(kind: str, share: Tensor, q: Tensor, q2: Tensor) -> Tensor:
    """p(q, q') of one joint as the paper writes it."""
    sigma, alpha, beta = share
    if kind == "revolute":
        return sigma + alpha * torch.cos(q) * torch.cos(q2) + beta * torch.sin(q) * torch.sin(q2)
    return sigma + beta + alpha * q * q2


def lip_energies(
    joint_types: Sequence[str],
    potential: tuple[Tensor, Tensor],
    kinetic: Sequence[tuple[Tensor, Tensor]],
) -> list[tuple[Energy, bool]]:
    """Energy kernels of the paper: [(kernel, is kinetic)]; `potential` is (scale, shares), `kinetic` (weights, shares)."""

    def make_potential(scale: Tensor, share: Tensor) -> Energy:
        def kernel(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
            value = scale
            for b, kind in enumerate(joint_types):
                value = value * base_kernel(kind, share[b], q[b], q2[b])
            return value

        return kernel

    def make_kinetic(weights: Tensor, share: Tensor) -> Energy:
        def kernel(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
            count = len(weights)
            value = (weights * v[:count] * v2[:count]).sum() ** 2
            for b in range(count):
                value = value * base_kernel(joint_types[b], share[b], q[b], q2[b]) ** 2
            return value

        return kernel

    return [(make_potential(*potential), False)] + [(make_kinetic(*term), True) for term in kinetic]


def lagrange(energy: Callable[[Tensor, Tensor], Tensor], q: Tensor, v: Tensor, a: Tensor, kinetic: bool) -> Tensor:
    """tau = d/dt(∂L/∂v) − ∂L/∂q by automatic differentiation; L is +energy (kinetic) or −energy (potential)."""
    sign = 1.0 if kinetic else -1.0
    q, v = q.detach().requires_grad_(True), v.detach().requires_grad_(True)
    value = sign * energy(q, v)
    dq, dv = torch.autograd.grad(value, (q, v), create_graph=True, allow_unused=True, materialize_grads=True)
    # d/dt of ∂L/∂v along (v, a)
    rows = []
    for i in range(len(q)):
        hq, hv = torch.autograd.grad(
            dv[i], (q, v), create_graph=True, allow_unused=True, materialize_grads=True
        ) if dv[i].requires_grad else (torch.zeros_like(q), torch.zeros_like(v))
        rows.append((hq * v).sum() + (hv * a).sum() - dq[i])
    return torch.stack(rows)


def torque_block(energies: Sequence[tuple[Energy, bool]], x: Sequence[Tensor], y: Sequence[Tensor]) -> Tensor:
    """cov(tau_i(x), tau_j(y)), (n, n), with Lagrange's operator applied by autograd to both arguments."""
    n = len(x[0])
    total = torch.zeros((n, n), dtype=torch.float64)
    for kernel, kinetic in energies:
        for j in range(n):
            # the operator on the second argument gives a function of the first, on which it is applied again
            def right(q: Tensor, v: Tensor, kernel: Energy = kernel, j: int = j, kinetic: bool = kinetic) -> Tensor:
                return lagrange(lambda q2, v2: kernel(q, v, q2, v2), *y, kinetic)[j]

            total[:, j] += lagrange(right, *x, kinetic).detach()
    return total
