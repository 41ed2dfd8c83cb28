"""The geometrically inspired polynomial baseline: each joint's torque as a polynomial, independent of the others.

A. Dalla Libera and R. Carli, "A data-efficient geometrically inspired polynomial kernel for robot inverse dynamics",
IEEE RA-L 2020: rigid-body torques are of degree one in (1, ddq_a, dq_a dq_b) and of degree two in each joint's
(cos q_b, sin q_b), or q_b where it is prismatic. Their multiplicative polynomial kernel of degree d is a product of d
linear kernels, each with parameters of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lipcore.kernels.base import PairKernel, Params, State
from lipcore.kernels.se import SPREAD_FLOOR, SPREAD_SHARE, independent_blocks, per_joint, power
from lipcore.motion import JointType, Motion, check_joint_types

FACTOR_LOGITS = (-2.0, -4.0)
"""Starting logits of a joint's two position factors: were they equal, their gradients would keep them equal. Starts
nearer to zero ended with less evidence on a simulated Panda."""
DEGREE = len(FACTOR_LOGITS)


class GeometricallyInspiredKernel(PairKernel):
    """k_i = [c_i + Σ_a w_{i,a} ddq_a ddq'_a + (Σ_a u_{i,a} dq_a dq'_a)²] Π_b p_{i,b,1} p_{i,b,2} for each joint i.

    p = σ + α cos q cos q' + β sin q sin q' for revolute, σ + β + α q q' for prismatic joints, with σ + α + β = 1: the
    scale lives in c, w and u. The square weighs dq_a dq_b by u_a u_b, the paper every product by a number of its own.

    Hyperparameters of all joints i: `gip.log_constant` (n,), log c; `gip.log_acceleration` (n, n), log w;
    `gip.log_velocity` (n, n), log u; `gip.logits` (n, n, 2, 2), joint i × joint b × factor × (α, β).
    """

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)², zero for i ≠ j."""
        acceleration = torch.tensordot(torch.exp(params["gip.log_acceleration"]), x.a * y.a, dims=1)
        velocity = torch.tensordot(torch.exp(params["gip.log_velocity"]), x.v * y.v, dims=1)
        constant = per_joint(torch.exp(params["gip.log_constant"]), velocity)
        dynamic = constant + acceleration + velocity.square()
        return independent_blocks(dynamic * self._position(params["gip.logits"], x.q, y.q))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """A third of the measured power each from the constant, all accelerations and all velocity products."""
        n = self.n_joints
        logits = (
            torch.tensor(FACTOR_LOGITS, dtype=tau.dtype, device=tau.device)[:, None].expand(n, n, DEGREE, 2).clone()
        )
        position = self._position(logits, motion.q.T, motion.q.T).mean(1)
        third = power(tau) / position / 3
        return {
            "gip.log_constant": torch.log(third),
            "gip.log_acceleration": torch.log(third[:, None] / (n * _power(motion.ddq))),
            "gip.log_velocity": torch.log(third.sqrt()[:, None] / (n * _power(motion.dq))),
            "gip.logits": logits,
        }

    def _position(self, logits: Tensor, q: Tensor, q2: Tensor) -> Tensor:
        """Π_b p_{i,b,1} p_{i,b,2} of every joint i: (n, *batch)."""
        first, second = torch.cos(q) * torch.cos(q2), torch.sin(q) * torch.sin(q2)
        shares = torch.softmax(torch.cat([torch.zeros_like(logits[..., :1]), logits], dim=-1), dim=-1)
        total = torch.ones_like(first)
        for b, kind in enumerate(self.joint_types):
            one, two = (first[b], second[b]) if kind == "revolute" else (q[b] * q2[b], torch.ones_like(first[b]))
            for factor in range(DEGREE):
                sigma, alpha, beta = (per_joint(share, first) for share in shares[:, b, factor].unbind(1))
                total = total * (sigma + alpha * one + beta * two)
        return total


def _power(values: Tensor) -> Tensor:
    """Mean square of each joint's values, (N, n) to (n,), floored for joints that stand still."""
    mean = values.square().mean(0)
    return torch.maximum(mean, SPREAD_SHARE**2 * mean.max()).clamp_min(SPREAD_FLOOR**2)
