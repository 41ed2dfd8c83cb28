"""Joint friction: viscous, Coulomb and offset torque, independent per joint."""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.kernels.base import Params, State, TorqueKernel
from lipcore.motion import Motion

SIGN_WIDTH = 0.02
"""Velocity over which the Coulomb sign turns over, rad/s (m/s): tanh(dq / width) avoids a jump at standstill."""


def friction_features(dq: Tensor) -> Tensor:
    """[dq, sign(dq) smoothed, 1]: (3, *dq.shape)."""
    return torch.stack([dq, torch.tanh(dq / SIGN_WIDTH), torch.ones_like(dq)])


class FrictionKernel(TorqueKernel):
    """Linear friction model tau_i = f_v dq_i + f_c sign(dq_i) + f_o with independent Gaussian weights."""

    def __init__(self, n_joints: int) -> None:
        self.n_joints = n_joints

    def blocks(self, params: Params, x: State, y: State) -> Tensor:
        """Diagonal blocks Σ_f s_f² φ_f(dq_i) φ_f(dq'_i): (n, n, *batch)."""
        variance = torch.exp(2 * params["friction.log_std"]).T  # (3, n)
        variance = variance.reshape(variance.shape + (1,) * (x.v.dim() - 1))
        diagonal = (variance * friction_features(x.v) * friction_features(y.v)).sum(0)
        return torch.diag_embed(diagonal.movedim(0, -1)).movedim((-2, -1), (0, 1))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """A tenth of each joint's torque for every feature at the joint's usual speed: log std (n, 3)."""
        usual = tau.square().mean(0).sqrt().clamp_min(1e-6) * 0.1
        speed = motion.dq.square().mean(0).sqrt().clamp_min(1e-3)
        return {"friction.log_std": torch.log(torch.stack([usual / speed, usual, usual], dim=1))}
