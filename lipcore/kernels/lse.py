"""The Lagrangian squared exponential baseline: one smooth prior of L(q, dq), without polynomials (TR2023-063).

Primes mark the second argument, D = Σ_k v_k ∂/∂q_k + a_k ∂/∂v_k is the time derivative and T_i = D ∂/∂v_i − ∂/∂q_i
makes L a torque. The prior is

    K = s² Π_b κ_b(q_b − q'_b) exp(−½ Σ_b c_b (v_b − v'_b)²),   c_b = 1 / m_b²

with κ = exp((cos(q − q') − 1) / ℓ²), the squared exponential of (cos q, sin q), for revolute joints and
κ = exp(−(q − q')² / (2 ℓ²)) for prismatic joints. K is nowhere zero, and all its derivatives are multiples of K. With

    e = ∂ log κ / ∂q,  d = ∂² log κ / ∂q²,  g = −c∘(v − v'),  b = c∘a,  b' = c∘a',
    Λ = e·v + g·a,  Λ' = e·v' + g·a',  Ω = Σ d v v' − Σ c a a',  x = b − Λ g,  y = b' − Λ' g

the nine products of left and right derivatives in T_i T'_j K collect into four matrices of rank one and a diagonal:

    block / K = (x + e)(y − e)ᵀ + y xᵀ + g ((Ω − ΛΛ') g + d∘v)ᵀ − (d∘v') gᵀ − diag((Ω + ΛΛ') c + d)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.kernels.arrays import on_diagonal
from lipcore.kernels.base import PairKernel, Params, State
from lipcore.kernels.independent import per_joint, power, spread
from lipcore.vocabulary import JointType


class LagrangianSEKernel(PairKernel):
    """One squared exponential kernel for the whole Lagrangian, on (cos q, sin q, dq); on q itself for prismatic joints.

    Hyperparameters:

    - `lse.log_scale` (): log s² in J²;
    - `lse.log_position_lengthscales` (n,): log ℓ, without unit (prismatic: m);
    - `lse.log_velocity_lengthscales` (n,): log m in rad/s (m/s).
    """

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²."""
        xp = array_namespace(x.q)
        log_k, e, d = self._position(params["lse.log_position_lengthscales"], x.q, y.q)
        c = per_joint(xp.exp(-2 * params["lse.log_velocity_lengthscales"]), x.v)
        u = x.v - y.v
        g, b, b2 = -c * u, c * x.a, c * y.a
        k = xp.exp(params["lse.log_scale"] + (log_k + 0.5 * g * u).sum(0))
        rate, rate2 = (e * x.v + g * x.a).sum(0), (e * y.v + g * y.a).sum(0)
        both = rate * rate2
        omega = (d * x.v * y.v - b * y.a).sum(0)

        left, right = b - rate * g, b2 - rate2 * g
        kg = k * g
        block = (k * (left + e))[:, None] * (right - e)
        block = block + (k * right)[:, None] * left
        block = block + kg[:, None] * ((omega - both) * g + d * x.v)
        block = block - (d * y.v)[:, None] * kg
        return block - on_diagonal(k * ((omega + both) * c + d))

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return the start: length scales are the spreads of the inputs times √(2 n), and power is that of the torque.

        The factor √(2 n) is there because the distances of the 2 n inputs add up.
        """
        circle = np.hypot(spread(np.cos(motion.q)), spread(np.sin(motion.q)))
        position = np.where(self._revolute(), circle, spread(motion.q))
        inputs = (2 * self.n_joints) ** 0.5
        params = {
            "lse.log_scale": np.zeros(()),
            "lse.log_position_lengthscales": np.log(position * inputs),
            "lse.log_velocity_lengthscales": np.log(spread(motion.dq) * inputs),
        }
        unit = np.einsum("kii->i", self.variance(params, motion)) / len(motion)
        params["lse.log_scale"] = np.asarray(np.log(power(tau).sum() / unit.sum()))
        return params

    def _position(self, log_lengthscales: Array, q: Array, q2: Array) -> tuple[Array, Array, Array]:
        """Return log κ and its first and second derivative by q, each (n, *batch)."""
        xp, z = array_namespace(q), q - q2
        c = per_joint(xp.exp(-2 * log_lengthscales), z)
        sin, cos = xp.sin(z), xp.cos(z)
        # this form of cos z − 1 avoids cancellation
        log_k, e, d = -2 * xp.square(xp.sin(0.5 * z)), -sin, -cos
        if "prismatic" in self.joint_types:
            revolute = xp.asarray(self._revolute().reshape((-1,) + (1,) * (z.ndim - 1)), device=device(z))
            log_k = xp.where(revolute, log_k, -0.5 * xp.square(z))
            e = xp.where(revolute, e, -z)
            d = xp.where(revolute, d, -xp.ones_like(z))
        return c * log_k, c * e, c * d

    def _revolute(self) -> NDArray[np.bool_]:
        """Return a mask of the revolute joints, (n,)."""
        return np.array([kind == "revolute" for kind in self.joint_types])
