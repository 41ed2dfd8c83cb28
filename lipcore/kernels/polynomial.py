"""Polynomial kernels on joint positions and their derivatives.

The energies of a manipulator are polynomials in (cos q_b, sin q_b) of revolute and q_b of prismatic joints
(TR2023-063). A product over joints of one small base kernel each spans them. Everything here is free of
division, so a base kernel may pass through zero without loss of precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.vocabulary import JointType


@dataclass(frozen=True)
class Derivatives:
    """A kernel K(q, q') over n joints with the derivatives that Lagrange's equations need.

    value: (*batch); left: ∂K/∂q_i, right: ∂K/∂q'_j, both (n, *batch); mixed: ∂²K/∂q_i∂q'_j, (n, n, *batch).
    """

    value: Tensor
    left: Tensor
    right: Tensor
    mixed: Tensor


@dataclass(frozen=True)
class BaseKernels:
    """One base kernel p_b(q_b, q'_b) a joint with p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q', each (n, *batch)."""

    value: Tensor
    left: Tensor
    right: Tensor
    mixed: Tensor

    def squared(self) -> BaseKernels:
        """p², for the kinetic energy: degree two in each joint's cosine and sine."""
        p = self.value
        return BaseKernels(p * p, 2 * p * self.left, 2 * p * self.right, 2 * (p * self.mixed + self.left * self.right))


def base_kernels(shares: Tensor, joint_types: Sequence[JointType], q: Tensor, q2: Tensor) -> BaseKernels:
    """Base kernels of all joints of the paper, TR2023-063.

    revolute: p = σ + α cos q cos q' + β sin q sin q'; prismatic: p = (σ + β) + α q q'.
    shares: (n, 3) with columns σ, α, β; q, q2: (n, *batch), batches broadcast.
    """
    dims = (-1,) + (1,) * (q.dim() - 1)
    sigma, alpha, beta = (column.reshape(dims) for column in shares.unbind(1))
    if "prismatic" not in joint_types:
        return _revolute(sigma, alpha, beta, q, q2)
    # computed for every joint, then chosen: robots that mix the two types are small
    prismatic = torch.tensor([kind == "prismatic" for kind in joint_types], device=q.device).reshape(dims)
    straight, round_ = _prismatic(sigma + beta, alpha, q, q2), _revolute(sigma, alpha, beta, q, q2)
    return BaseKernels(
        *(
            torch.where(prismatic, getattr(straight, name), getattr(round_, name))
            for name in ("value", "left", "right", "mixed")
        )
    )


def _revolute(sigma: Tensor, alpha: Tensor, beta: Tensor, q: Tensor, q2: Tensor) -> BaseKernels:
    cos, sin, cos2, sin2 = torch.cos(q), torch.sin(q), torch.cos(q2), torch.sin(q2)
    ac, as_, bc, bs = alpha * cos, alpha * sin, beta * cos, beta * sin
    return BaseKernels(
        sigma + ac * cos2 + bs * sin2, bc * sin2 - as_ * cos2, bs * cos2 - ac * sin2, as_ * sin2 + bc * cos2
    )


def _prismatic(sigma: Tensor, alpha: Tensor, q: Tensor, q2: Tensor) -> BaseKernels:
    slope = alpha * torch.ones_like(q * q2)
    return BaseKernels(sigma + slope * q * q2, slope * q2, slope * q, slope)


def product(base: BaseKernels, scale: Tensor) -> Derivatives:
    """scale Π_b p_b with derivatives. scale: ()."""
    return chain_sum(base, torch.cat([scale.new_zeros(len(base.value) - 1), scale[None]]))


def chain_sum(base: BaseKernels, scales: Tensor) -> Derivatives:
    """Σ_l s_l Π_{b≤l} p_b with derivatives, from tip to base: K ← p_b (s_b + K). scales: s, (n,)."""
    last = base.value.shape[0] - 1
    scale = scales[last]
    value = scale * base.value[last]
    left, right, mixed = scale * base.left[last:], scale * base.right[last:], scale * base.mixed[last:, None]
    for b in range(last - 1, -1, -1):
        p, lead, trail, both = base.value[b], base.left[b], base.right[b], base.mixed[b]
        inner = scales[b] + value
        upper = torch.cat([(inner * both)[None], right * lead], dim=0)
        lower = torch.cat([(left * trail)[:, None], mixed * p], dim=1)
        mixed = torch.cat([upper[None], lower], dim=0)
        left = torch.cat([(inner * lead)[None], left * p], dim=0)
        right = torch.cat([(inner * trail)[None], right * p], dim=0)
        value = inner * p
    return Derivatives(value, left, right, mixed)
