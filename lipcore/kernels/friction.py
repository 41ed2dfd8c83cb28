"""Joint friction: viscous, Coulomb and offset torque, independent per joint."""

from __future__ import annotations

import torch
from torch import Tensor

from lipcore.kernels.base import LinearKernel, Params
from lipcore.kernels.compiled.friction import friction_rows
from lipcore.kernels.regressor import Array, Regressor
from lipcore.motion import Motion

SIGN_WIDTH = 0.02
"""Velocity over which the Coulomb sign turns over, rad/s (m/s): tanh(dq / width) avoids a jump at standstill."""
FRICTION_TERMS = ("viscous", "coulomb", "offset")


def friction_features(dq: Tensor) -> Tensor:
    """[dq, sign(dq) smoothed, 1]: (3, *dq.shape)."""
    return torch.stack([dq, torch.tanh(dq / SIGN_WIDTH), torch.ones_like(dq)])


class FrictionKernel(LinearKernel):
    """Linear friction model tau_i = f_v dq_i + f_c sign(dq_i) + f_o with independent Gaussian weights.

    Weights joint by joint, FRICTION_TERMS each: (3 n,). Hyperparameter: `friction.log_std` (n, 3).
    """

    def __init__(self, n_joints: int) -> None:
        self.n_joints = n_joints

    def features(self, x: Motion) -> Tensor:
        """Each joint's three features in its own row: (N, n, 3 n)."""
        n = self.n_joints
        features = friction_features(x.dq).permute(1, 2, 0)  # (N, n, 3)
        out = torch.zeros((len(x), n, n, 3), dtype=x.dq.dtype, device=x.device)
        joints = torch.arange(n, device=x.device)
        out[:, joints, joints] = features
        return out.reshape(len(x), n, 3 * n)

    def regressor(self) -> Regressor:
        """The same features of one query, for serving."""
        return FrictionRegressor(self.n_joints)

    def covariance(self, params: Params) -> Tensor:
        """Prior variances on the diagonal: (3 n, 3 n)."""
        return torch.diag(torch.exp(2 * params["friction.log_std"]).reshape(-1))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """A tenth of each joint's torque for every feature at the joint's usual speed: log std (n, 3)."""
        usual = tau.square().mean(0).sqrt().clamp_min(1e-6) * 0.1
        speed = motion.dq.square().mean(0).sqrt().clamp_min(1e-3)
        return {"friction.log_std": torch.log(torch.stack([usual / speed, usual, usual], dim=1))}


class FrictionRegressor(Regressor):
    """Features of `FrictionKernel`, compiled."""

    def __init__(self, n_joints: int) -> None:
        self.n_joints, self.size = n_joints, len(FRICTION_TERMS) * n_joints

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (3 n, n)."""
        friction_rows(motion, SIGN_WIDTH, out)
