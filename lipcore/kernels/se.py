"""The squared exponential baseline of TR2023-063: one Gaussian process a joint that knows nothing of mechanics."""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import PairKernel, Params, State

SPREAD_SHARE = 0.1
"""Smallest spread credited to a joint, relative to that of the joint that moves most: some joints stand still."""
SPREAD_FLOOR = 1e-3
"""Smallest spread credited to any input, in its own unit."""
LEAST_LENGTHSCALES = (2.0, 4.0, 40.0)
"""Shortest lengthscales to start from, rad, rad/s and rad/s² (m): a turn of gravity, and speeds and accelerations at
which inertia bears as much torque as weight. Motion within a small range tells nothing of shorter ones."""
WEIGHTLESS_SHARE = 0.05
"""A joint with less than this share of the torque of the joints behind it bears inertia rather than weight."""
PRIOR_STD = {"se.log_scale": 2.0, "se.log_lengthscales": 1.0}
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
        return dict(PRIOR_STD)


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
