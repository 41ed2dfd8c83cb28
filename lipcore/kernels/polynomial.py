"""Polynomial kernels on joint positions, and their derivatives.

The energies of a manipulator are polynomials in (cos q_b, sin q_b) of revolute joints and q_b of prismatic joints
(TR2023-063). A product over joints of one small base kernel each spans them. No formula here divides. A base kernel may
therefore pass through zero without loss of precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array
from lipcore.vocabulary import JointType


@dataclass(frozen=True)
class BaseKernels:
    """One base kernel p_b(q_b, q'_b) for each joint: p, ∂p/∂q, ∂p/∂q' and ∂²p/∂q∂q', each (n, *batch)."""

    value: Array
    left: Array
    right: Array
    mixed: Array

    def squared(self) -> BaseKernels:
        """Return p², for the kinetic energy: degree two in each joint's cosine and sine."""
        p = self.value
        return BaseKernels(p * p, 2 * p * self.left, 2 * p * self.right, 2 * (p * self.mixed + self.left * self.right))


@dataclass(frozen=True)
class Product:
    """K(q, q') = s Π_b p_b over some joints b, with the derivatives that Lagrange's equations need."""

    base: BaseKernels
    """Base kernels of at least m joints."""
    joints: range
    """Joints of the product."""
    scale: Array
    """s, ()."""
    size: int
    """m, the number of joints to differentiate by."""

    @cached_property
    def value(self) -> Array:
        """K, (*batch)."""
        return self._derivative()

    @cached_property
    def left(self) -> Array:
        """∂K/∂q_i, (m, *batch)."""
        return self._stack([self._derivative(left=i) for i in range(self.size)])

    @cached_property
    def right(self) -> Array:
        """∂K/∂q'_j, (m, *batch)."""
        return self._stack([self._derivative(right=j) for j in range(self.size)])

    @cached_property
    def mixed(self) -> Array:
        """∂²K/∂q_i∂q'_j, (m, m, *batch)."""
        joints = range(self.size)
        return self._stack([self._stack([self._derivative(i, j) for j in joints]) for i in joints])

    def _derivative(self, left: int | None = None, right: int | None = None) -> Array:
        """Return K, differentiated by q of joint `left` and by q' of joint `right`."""
        nothing = array_namespace(self.base.value).zeros_like(self.base.value[0])
        if not all(joint in self.joints for joint in (left, right) if joint is not None):
            return nothing
        total = self.scale + nothing
        for b in self.joints:
            part = self.base.mixed if left == right == b else self.base.left if left == b else self.base.value
            total = total * (self.base.right if right == b != left else part)[b]
        return total

    def _stack(self, parts: list[Array]) -> Array:
        return array_namespace(self.scale).stack(parts)


def base_kernels(shares: Array, joint_types: Sequence[JointType], q: Array, q2: Array) -> BaseKernels:
    """Return the base kernels of all joints (TR2023-063).

    revolute: p = σ + α cos q cos q' + β sin q sin q'; prismatic: p = (σ + β) + α q q'. shares: (n, 3) with columns σ,
    α, β; q, q2: (n, *batch), batches broadcast.
    """
    xp, dims = array_namespace(shares), (-1,) + (1,) * (q.ndim - 1)
    sigma, alpha, beta = (shares[:, column].reshape(dims) for column in range(3))
    if "prismatic" not in joint_types:
        return _revolute(sigma, alpha, beta, q, q2)
    # computing both types for every joint is cheap: robots that mix them are small
    kinds = np.array([kind == "prismatic" for kind in joint_types]).reshape(dims)
    prismatic = xp.asarray(kinds)
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
