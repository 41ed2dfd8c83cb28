"""Slow, independent references: the definition, differentiated by machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacrev

from lipcore.data.motion import Motion

Instant = tuple[Tensor, Tensor, Tensor]
"""(q, v, a) of one sample, each (n,)."""


@dataclass(frozen=True)
class Energy:
    """One independent energy. kernel: k(q, v, q', v'), scalar; sign in the Lagrangian: + kinetic, − potential."""

    kernel: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    sign: int


def base_kernel(kind: str, share: Tensor, q: Tensor, q2: Tensor) -> Tensor:
    """p(q, q') of one joint as the paper writes it."""
    sigma, alpha, beta = share
    if kind == "revolute":
        return sigma + alpha * torch.cos(q) * torch.cos(q2) + beta * torch.sin(q) * torch.sin(q2)
    return sigma + beta + alpha * q * q2


def shares_of(logits: Tensor) -> Tensor:
    """(σ, α, β) of each joint, (n, 3): proportional to (1, e^first, e^second), summing to one."""
    parts = torch.cat([torch.ones(len(logits), 1, dtype=logits.dtype), torch.exp(logits)], dim=1)
    return parts / parts.sum(1, keepdim=True)


def pooled_weight(params: Mapping[str, Tensor], link: int, joint: int) -> Tensor:
    """w_{l,a} of link l and joint a ≤ l, both counted from 0: five logarithms added up."""
    before = sum(range(link + 1))  # deviations run link by link, a link's first joint first
    return torch.exp(
        params["kinetic.log_scale"]
        + params["kinetic.log_link"][link]
        + params["kinetic.log_joint"][joint]
        + params["kinetic.log_gap"][link - joint]
        + params["kinetic.log_deviation"][before + joint]
    )


def lip_energies(joint_types: Sequence[str], params: Mapping[str, Tensor]) -> list[Energy]:
    """Energies of the paper: the potential over all joints, then one kinetic energy for each link."""
    potential_shares = shares_of(params["potential.logits"])
    scale = torch.exp(params["potential.log_scale"])

    def potential(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
        value = scale
        for b, kind in enumerate(joint_types):
            value = value * base_kernel(kind, potential_shares[b], q[b], q2[b])
        return value

    energies = [Energy(potential, -1)]
    for link in range(1, len(joint_types) + 1):
        weights = torch.stack([pooled_weight(params, link - 1, joint) for joint in range(link)])
        logits = params["kinetic.logits"] if "kinetic.logits" in params else params[f"kinetic.{link}.logits"]
        link_shares = shares_of(logits)

        def kinetic(
            q: Tensor, v: Tensor, q2: Tensor, v2: Tensor, weights: Tensor = weights, share: Tensor = link_shares
        ) -> Tensor:
            count = len(weights)
            value = (weights * v[:count] * v2[:count]).sum() ** 2
            for b in range(count):
                value = value * base_kernel(joint_types[b], share[b], q[b], q2[b]) ** 2
            return value

        energies.append(Energy(kinetic, +1))
    return energies


def chain_base_kernel(kind: str, alpha: Tensor, q: Tensor, q2: Tensor) -> Tensor:
    """p(q, q') of one joint of a chain, which has no zero where it is revolute."""
    return 1 - alpha + alpha * (torch.cos(q - q2) if kind == "revolute" else q * q2)


def chain_energies(joint_types: Sequence[str], params: Mapping[str, Tensor]) -> list[Energy]:
    """Energies of a serial chain: the potentials of all links added up, then one kinetic energy for each link."""
    n, scales = len(joint_types), torch.exp(params["potential.log_scales"])
    alpha = 1 / (1 + torch.exp(-params["chain.logits"]))

    def base(b: int, q: Tensor, q2: Tensor) -> Tensor:
        return chain_base_kernel(joint_types[b], alpha[b], q[b], q2[b])

    def potential(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
        total = torch.zeros((), dtype=q.dtype)
        for link in range(n):
            value = scales[link]
            for b in range(link + 1):
                value = value * base(b, q, q2)
            total = total + value
        return total

    def kinetic_of(link: int) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
        weights = [pooled_weight(params, link, joint) for joint in range(link + 1)]

        def kinetic(q: Tensor, v: Tensor, q2: Tensor, v2: Tensor) -> Tensor:
            total = torch.zeros((), dtype=q.dtype)
            for joint, weight in enumerate(weights):
                term = weight * v[joint] * v2[joint]
                for b in range(joint + 1, link + 1):
                    term = term * base(b, q, q2)
                total = total + term
            return total**2

        return kinetic

    return [Energy(potential, -1), *(Energy(kinetic_of(link), +1) for link in range(n))]


def lagrange(lagrangian: Callable[[Tensor, Tensor], Tensor], q: Tensor, v: Tensor, a: Tensor) -> Tensor:
    """d/dt(∂L/∂v) − ∂L/∂q of every entry of L(q, v), the joint as last axis."""
    momentum = jacrev(lagrangian, argnums=1)
    by_q, by_v = jacrev(momentum, argnums=(0, 1))(q, v)
    return by_q @ v + by_v @ a - jacrev(lagrangian, argnums=0)(q, v)


def torque_terms(energies: Sequence[Energy], x: Instant, y: Instant) -> Tensor:
    """cov(tau_i(x), tau_j(y)) due to each energy alone, (energies, n, n)."""

    def block(energy: Energy) -> Tensor:
        def at_y(q: Tensor, v: Tensor) -> Tensor:
            return lagrange(lambda q2, v2: energy.kernel(q, v, q2, v2), *y)

        return lagrange(at_y, *x).T  # the sign enters twice

    return torch.stack([block(energy) for energy in energies])


def energy_torque(energies: Sequence[Energy], x: Instant, y: Instant) -> Tensor:
    """cov(energy(x), tau_j(y)) of each energy, (energies, n)."""
    q, v, _ = x
    return torch.stack([e.sign * lagrange(lambda q2, v2, e=e: e.kernel(q, v, q2, v2), *y) for e in energies])


def scale_of(energies: Sequence[Energy], x: Instant, y: Instant, terms: Tensor) -> float:
    """Size that rounding errors are relative to: the largest entry of any one term, or the energies themselves.

    The sum of the terms may cancel, and so may a term where the derivative of a base kernel is zero.
    """
    values = [float(energy.kernel(*x[:2], *y[:2]).abs()) for energy in energies]
    return max(float(terms.abs().max()), *values)


def instant(motion: Motion, row: int) -> Instant:
    """One sample of a motion."""
    return motion.q[row], motion.dq[row], motion.ddq[row]
