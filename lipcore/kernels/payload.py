"""The kernel of a payload: a body on the last link of an arm, torque linear in its ten parameters."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.compiled.arm import arm_energies, arm_masses
from lipcore.kernels.compiled.arm_recursion import PARAMETERS


class PayloadKernel(LinearKernel):
    """tau = b(θ) π, b = ∂(Y π)/∂π of the last link of an arm, at the geometry θ that it is linearised around.

    Where the geometry is learnt, torque is bilinear in a step δθ of it and in π. What a payload π̄ adds by δθ,
    J(θ, π̄) δθ, is the arm's own, linearised with the payload in its parameters (`ArmKernel`). b is that of θ, not of
    θ + E δθ: torque leaves directions open along which E δθ is large, while its effect cancels to first order only.

    Weights: π (10,). arm: θ and the order of its joints; room: prior variance of π, (10,).
    """

    def __init__(self, arm: Arm, room: Array) -> None:
        self.n_joints, self._room = arm.n_joints, np.array(room)
        self._order, self._gravity = arm.order.astype(np.int64), arm.geometry.gravity
        self._constants = arm.geometry.constants
        first = PARAMETERS * int(arm.order[-1])
        self._last = slice(first, first + PARAMETERS)

    def rows(self, motions: Array) -> Array:
        """Φᵀ of N motions (N, 3, n): (N, 10, n)."""
        out = np.empty((len(motions), PARAMETERS * self.n_joints, self.n_joints))
        arm_masses(self._constants, self._gravity, self._order, motions, out)
        return out[:, self._last]

    def features(self, x: Motion) -> Tensor:
        """Φ at each sample: (N, n, 10)."""
        return torch.from_numpy(np.ascontiguousarray(self.rows(x.arrays()).transpose(0, 2, 1)))

    def energy_features(self, x: Motion) -> Tensor:
        """Kinetic and potential energy per unit of each weight: (N, 2, 10) J."""
        out = np.empty((len(x), 2, (PARAMETERS + 1) * self.n_joints))
        none = np.zeros((self.n_joints, PARAMETERS))
        arm_energies(self._constants, self._gravity, none, self._order, x.arrays(), out)
        return torch.from_numpy(np.ascontiguousarray(out[..., self._last]))

    def regressor(self) -> Regressor:
        """The same features of one query, for serving."""
        return PayloadRegressor(self)

    def covariance(self, params: Params) -> Tensor:
        """Prior variances of the weights on the diagonal: (10, 10)."""
        return torch.diag(torch.from_numpy(self._room))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """No hyperparameters."""
        return {}


class PayloadRegressor(Regressor):
    """Features of `PayloadKernel`, one query at a time."""

    def __init__(self, kernel: PayloadKernel) -> None:
        self.n_joints, self.size = kernel.n_joints, PARAMETERS
        self._kernel = kernel

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (10, n)."""
        out[:] = self._kernel.rows(motion[None])[0]
