"""The baselines of TR2023-063 that know each joint by itself: squared exponential and geometrically inspired.

A. Dalla Libera and R. Carli, "A data-efficient geometrically inspired polynomial kernel for robot inverse dynamics",
IEEE RA-L 2020: rigid-body torques are of degree one in (1, ddq_a, dq_a dq_b) and of degree two in each joint's
(cos q_b, sin q_b), or q_b where it is prismatic. Their multiplicative polynomial kernel of degree d is a product of d
linear kernels, each with parameters of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lipcore.data.motion import Motion, check_joint_types
from lipcore.kernels.base import PairKernel, Params, State
from lipcore.vocabulary import JointType

SPREAD_SHARE = 0.1
"""Smallest spread credited to a joint, relative to that of the joint that moves most: some joints stand still."""
SPREAD_FLOOR = 1e-3
"""Smallest spread credited to any input, in its own unit."""
LEAST_LENGTHSCALES = (2.0, 4.0, 40.0)
"""Shortest lengthscales to start from, rad, rad/s and rad/s² (m): a turn of gravity, and speeds and accelerations at
which inertia bears as much torque as weight. Motion within a small range tells nothing of shorter ones."""
WEIGHTLESS_SHARE = 0.05
"""A joint with less than this share of the torque of the joints behind it bears inertia rather than weight."""
SE_PRIOR_STD = {"se.log_scale": 2.0, "se.log_lengthscales": 1.0}
"""Tighter than usual: 3 n lengthscales a joint, and a motion from which few of them can be told."""


class SquaredExponentialKernel(PairKernel):
    """k_i = s_i² exp(−½ Σ_d (x_d − x'_d)² / ℓ_{i,d}²) on x = (q, dq, ddq), independent for each joint i.

    Hyperparameters: `se.log_scale` (n,), log s_i² in (N·m)²; `se.log_lengthscales` (n, 3 n), log ℓ_{i,d} in the units
    of q, dq and ddq.
    """

    def __init__(self, n_joints: int) -> None:
        self.n_joints = n_joints

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)², zero for i ≠ j."""
        squares = torch.cat([x.q - y.q, x.v - y.v, x.a - y.a]).square()
        exponent = torch.tensordot(torch.exp(-2 * params["se.log_lengthscales"]), squares, dims=1)
        return independent_blocks(torch.exp(per_joint(params["se.log_scale"], exponent) - 0.5 * exponent))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """The measured power; every input's spread, times √(3 n) since squared distances add up over 3 n inputs.

        Those of dq and ddq have a floor that is lower for a joint that bears no weight: its torque is small already at
        the accelerations seen.
        """
        n, rms = self.n_joints, power(tau).sqrt()
        lengthscales = torch.cat([spread(motion.q), spread(motion.dq), spread(motion.ddq)]) * (3 * n) ** 0.5
        weight = (rms / (WEIGHTLESS_SHARE * largest_behind(rms))).clamp_max(1.0)
        factors = torch.stack([torch.ones_like(weight), weight.sqrt(), weight], dim=1)
        least = (factors * torch.tensor(LEAST_LENGTHSCALES, dtype=tau.dtype, device=tau.device)).repeat_interleave(
            n, dim=1
        )
        return {
            "se.log_scale": torch.log(power(tau)),
            "se.log_lengthscales": torch.log(torch.maximum(lengthscales, least)),
        }

    def prior_std(self) -> dict[str, float]:
        """How far scales and lengthscales may stray from their start."""
        return dict(SE_PRIOR_STD)


def independent_blocks(diagonal: Tensor) -> Tensor:
    """Blocks of joints that share nothing: (n, *batch) on the diagonal of (n, n, *batch)."""
    return torch.diag_embed(diagonal.movedim(0, -1)).movedim((-2, -1), (0, 1))


def per_joint(values: Tensor, like: Tensor) -> Tensor:
    """One number a joint, (n,), shaped to broadcast with `like`, (n, *batch)."""
    return values.reshape((-1,) + (1,) * (like.dim() - 1))


def spread(values: Tensor) -> Tensor:
    """Standard deviation of each joint's values, (N, n) to (n,), floored for joints that stand still."""
    std = values.std(0, correction=0)
    return torch.maximum(std, SPREAD_SHARE * std.max()).clamp_min(SPREAD_FLOOR)


def power(tau: Tensor) -> Tensor:
    """Mean square torque of each joint, (N, n) to (n,), (N·m)², kept above zero."""
    return tau.square().mean(0).clamp_min(1e-12)


def largest_behind(values: Tensor) -> Tensor:
    """Largest value of each joint and those after it, (n,): what they carry, it must carry too."""
    return values.flip(0).cummax(0).values.flip(0)


FACTOR_LOGITS = (0.0, -4.0)
"""Starting logits of a joint's two position factors: gravity is of degree one, so the second is nearly constant. Were
they equal, their gradients would keep them equal."""
DEGREE = len(FACTOR_LOGITS)
INERTIA_PER_TORQUE = 0.05
"""kg·m² per N·m of root mean square torque: where the weights of accelerations start."""
GIP_PRIOR_STD = {
    "gip.log_constant": 2.0,
    "gip.log_row": 1.0,
    "gip.log_column": 0.5,
    "gip.log_acceleration": 0.5,
    "gip.log_speed": 1.0,
    "gip.log_velocity": 0.5,
    "gip.logits": 1.0,
    "gip.logits_deviation": 1.0,
}
"""Chosen on fits to simulated data of a Panda. With logits tied more closely, a torque cannot tell the joints that do
not turn it."""


class GeometricallyInspiredKernel(PairKernel):
    """k_i = [c_i + Σ_a w_{i,a} ddq_a ddq'_a + (Σ_a u_{i,a} dq_a dq'_a)²] Π_b p_{i,b,1} p_{i,b,2} for each joint i.

    p = σ + α cos q cos q' + β sin q sin q' for revolute, σ + β + α q q' for prismatic joints, with σ + α + β = 1: the
    scale lives in c, w and u. The square weighs dq_a dq_b by u_a u_b, the paper every product by a number of its own.

    The weights are pooled, log w_{i,a} = 2 (r_i + m_a) + δ_{i,a} and log u_{i,a} = ½ log w_{i,a} + s_i + ε_{i,a}:
    inertia is large where both joints bear much, and velocity products have the size of an inertia. So are the position
    factors: their logits are those of joint b, the same for all torques, plus a deviation of joint i. Joints share
    nothing but hyperparameters.

    Hyperparameters: `gip.log_constant` (n,), log c; `gip.log_row` (n,), r; `gip.log_column` (n,), m;
    `gip.log_acceleration` (n, n), δ; `gip.log_speed` (n,), s; `gip.log_velocity` (n, n), ε; `gip.logits` (n, 2, 2),
    joint b × factor × (α, β); `gip.logits_deviation` (n, n, 2, 2), joint i × joint b × factor × (α, β).
    """

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)², zero for i ≠ j."""
        log_w, log_u = self._log_weights(params)
        acceleration = torch.tensordot(torch.exp(log_w), x.a * y.a, dims=1)
        velocity = torch.tensordot(torch.exp(log_u), x.v * y.v, dims=1)
        constant = per_joint(torch.exp(params["gip.log_constant"]), velocity)
        dynamic = constant + acceleration + velocity.square()
        logits = params["gip.logits"] + params["gip.logits_deviation"]
        return independent_blocks(dynamic * self._position(logits, x.q, y.q))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """The measured power from the constant; inertia as arms have it that need as much torque."""
        n, zeros = self.n_joints, tau.new_zeros
        logits = zeros((n, DEGREE, 2)) + torch.tensor(FACTOR_LOGITS, dtype=tau.dtype, device=tau.device)[:, None]
        position = self._position(logits.expand(n, n, DEGREE, 2), motion.q.T, motion.q.T).mean(1)
        # w is the square of an inertia, half of its logarithm from either joint
        half = 0.5 * torch.log(INERTIA_PER_TORQUE * largest_behind(power(tau).sqrt()))
        return {
            "gip.log_constant": torch.log(power(tau) / position),
            "gip.log_row": half,
            "gip.log_column": half.clone(),
            "gip.log_acceleration": zeros((n, n)),
            "gip.log_speed": zeros(n),
            "gip.log_velocity": zeros((n, n)),
            "gip.logits": logits,
            "gip.logits_deviation": zeros((n, n, DEGREE, 2)),
        }

    def prior_std(self) -> dict[str, float]:
        """How far the weights and shares may stray from their pattern, and the pattern from its start."""
        return dict(GIP_PRIOR_STD)

    def _log_weights(self, params: Params) -> tuple[Tensor, Tensor]:
        """log w and log u, each (n, n), joint i × joint a."""
        pattern = params["gip.log_row"][:, None] + params["gip.log_column"]
        log_w = 2 * pattern + params["gip.log_acceleration"]
        return log_w, 0.5 * log_w + params["gip.log_speed"][:, None] + params["gip.log_velocity"]

    def _position(self, logits: Tensor, q: Tensor, q2: Tensor) -> Tensor:
        """Π_b p_{i,b,1} p_{i,b,2} of every joint i: (n, *batch)."""
        first, second = torch.cos(q) * torch.cos(q2), torch.sin(q) * torch.sin(q2)
        shares = _position_shares(logits)
        total = torch.ones_like(first)
        for b, kind in enumerate(self.joint_types):
            one, two = (first[b], second[b]) if kind == "revolute" else (q[b] * q2[b], torch.ones_like(first[b]))
            for factor in range(DEGREE):
                sigma, alpha, beta = (per_joint(share, first) for share in shares[:, b, factor].unbind(1))
                total = total * (sigma + alpha * one + beta * two)
        return total


def _position_shares(logits: Tensor) -> Tensor:
    """Shares (σ, α, β) from the logits of α and β: (..., 2) to (..., 3)."""
    return torch.softmax(torch.cat([torch.zeros_like(logits[..., :1]), logits], dim=-1), dim=-1)
