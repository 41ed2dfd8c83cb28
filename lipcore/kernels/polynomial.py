"""Polynomial kernels on joint positions and their derivatives.

The energies of a manipulator are polynomials in (cos q_b, sin q_b) of revolute and q_b of prismatic joints
(TR2023-063). A product over joints of one small base kernel each spans them. Everything here is free of
division, so a base kernel may pass through zero without loss of precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace, device

from lipcore.data.motion import Array
from lipcore.vocabulary import JointType


@dataclass(frozen=True)
class Derivatives:
    """A kernel K(q, q') over n joints with the derivatives that Lagrange's equations need.

    value: (*batch); left: ∂K/∂q_i, right: ∂K/∂q'_j, both (n, *batch); mixed: ∂²K/∂q_i∂q'_j, (n, n, *batch).
    """

    value: Array
    left: Array
    right: Array
    mixed: Array


@dataclass(frozen=True)
class BaseKernels:
    """One base kernel p_b(q_b, q'_b) a joint with p, ∂p/∂q, ∂p/∂q', ∂²p/∂q∂q', each (n, *batch)."""

    value: Array
    left: Array
    right: Array
    mixed: Array

    def squared(self) -> BaseKernels:
        """p², for the kinetic energy: degree two in each joint's cosine and sine."""
        p = self.value
        return BaseKernels(p * p, 2 * p * self.left, 2 * p * self.right, 2 * (p * self.mixed + self.left * self.right))


def base_kernels(shares: Array, joint_types: Sequence[JointType], q: Array, q2: Array) -> BaseKernels:
    """Base kernels of all joints of the paper, TR2023-063.

    revolute: p = σ + α cos q cos q' + β sin q sin q'; prismatic: p = (σ + β) + α q q'.
    shares: (n, 3) with columns σ, α, β; q, q2: (n, *batch), batches broadcast.
    """
    xp, dims = array_namespace(shares), (-1,) + (1,) * (q.ndim - 1)
    sigma, alpha, beta = (shares[:, column].reshape(dims) for column in range(3))
    if "prismatic" not in joint_types:
        return _revolute(sigma, alpha, beta, q, q2)
    # computed for every joint, then chosen: robots that mix the two types are small
    kinds = np.array([kind == "prismatic" for kind in joint_types]).reshape(dims)
    prismatic = xp.asarray(kinds, device=device(q))
    straight, round_ = _prismatic(sigma + beta, alpha, q, q2), _revolute(sigma, alpha, beta, q, q2)
    return BaseKernels(
        *(
            xp.where(prismatic, getattr(straight, name), getattr(round_, name))
            for name in ("value", "left", "right", "mixed")
        )
    )


def _revolute(sigma: Array, alpha: Array, beta: Array, q: Array, q2: Array) -> BaseKernels:
    xp = array_namespace(q)
    cos, sin, cos2, sin2 = xp.cos(q), xp.sin(q), xp.cos(q2), xp.sin(q2)
    ac, as_, bc, bs = alpha * cos, alpha * sin, beta * cos, beta * sin
    return BaseKernels(
        sigma + ac * cos2 + bs * sin2, bc * sin2 - as_ * cos2, bs * cos2 - ac * sin2, as_ * sin2 + bc * cos2
    )


def _prismatic(sigma: Array, alpha: Array, q: Array, q2: Array) -> BaseKernels:
    slope = alpha * array_namespace(q).ones_like(q * q2)
    return BaseKernels(sigma + slope * q * q2, slope * q2, slope * q, slope)


def product(base: BaseKernels, scale: Array) -> Derivatives:
    """scale Π_b p_b with derivatives. scale: ()."""
    xp = array_namespace(scale)
    none = xp.zeros(len(base.value) - 1, dtype=scale.dtype, device=device(scale))
    return chain_sum(base, xp.concat([none, scale[None]]))


def chain_sum(base: BaseKernels, scales: Array) -> Derivatives:
    """Σ_l s_l Π_{b≤l} p_b with derivatives, from tip to base: K ← p_b (s_b + K). scales: s, (n,)."""
    xp, last = array_namespace(base.value), base.value.shape[0] - 1
    scale = scales[last]
    value = scale * base.value[last]
    left, right, mixed = scale * base.left[last:], scale * base.right[last:], scale * base.mixed[last:, None]
    for b in range(last - 1, -1, -1):
        p, lead, trail, both = base.value[b], base.left[b], base.right[b], base.mixed[b]
        inner = scales[b] + value
        upper = xp.concat([(inner * both)[None], right * lead], axis=0)
        lower = xp.concat([(left * trail)[:, None], mixed * p], axis=1)
        mixed = xp.concat([upper[None], lower], axis=0)
        left = xp.concat([(inner * lead)[None], left * p], axis=0)
        right = xp.concat([(inner * trail)[None], right * p], axis=0)
        value = inner * p
    return Derivatives(value, left, right, mixed)
