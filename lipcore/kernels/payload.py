"""The kernel of a payload: a body on the last link of an arm, torque linear in its ten parameters."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.compiled.arm import arm_masses, arm_shapes
from lipcore.kernels.compiled.arm_recursion import PARAMETERS

CERTAIN = 1e-12
"""Variance of the weight that is known to be one."""


class PayloadKernel(LinearKernel):
    """tau = b(θ + δ) π − J(θ, π̄) δ around a payload π̄ and a step δ of the geometry θ.

    Where the geometry is uncertain, a payload's torque is bilinear in it and in π. Around π̄ and δ it is
    b(θ + δ) π + J(θ, π̄) (δθ − δ) with b = ∂(Y π)/∂π of the last link. The part J δθ is the arm's own, linearised with
    the payload in its parameters (`ArmKernel`); this is the rest.

    Weights: π (10,), and one that is known to be 1. arm: θ and the order of its joints; step: δ, (g,) rad and m;
    payload: π̄, (10,); room: prior variance of π, (10,).
    """

    def __init__(self, arm: Arm, step: Array, payload: Array, room: Array) -> None:
        self.n_joints = arm.n_joints
        self._order, self._gravity = arm.order.astype(np.int64), arm.geometry.gravity
        self._still = arm.geometry.constants
        self._moved = arm.geometry.moved(step).constants if arm.steps else self._still
        self._step, self._room = np.array(step), np.array(room)
        self._bodies = np.zeros((arm.n_joints, PARAMETERS))
        self._bodies[-1] = payload
        first = PARAMETERS * int(arm.order[-1])
        self._last = slice(first, first + PARAMETERS)

    def rows(self, motions: Array) -> Array:
        """Φᵀ of N motions (N, 3, n): (N, 11, n)."""
        count, n = len(motions), self.n_joints
        bodies, out = np.empty((count, PARAMETERS * n, n)), np.empty((count, PARAMETERS + 1, n))
        arm_masses(self._moved, self._gravity, self._order, motions, bodies)
        out[:, :PARAMETERS], out[:, PARAMETERS] = bodies[:, self._last], 0.0
        if len(self._step):
            shapes = np.empty((count, len(self._step), n))
            arm_shapes(self._still, self._gravity, self._bodies, self._order, motions, shapes)
            out[:, PARAMETERS] = -np.tensordot(shapes, self._step, axes=(1, 0))
        return out

    def features(self, x: Motion) -> Tensor:
        """Φ at each sample: (N, n, 11)."""
        return torch.from_numpy(np.ascontiguousarray(self.rows(x.arrays()).transpose(0, 2, 1)))

    def regressor(self) -> Regressor:
        """The same features of one query, for serving."""
        return PayloadRegressor(self)

    def covariance(self, params: Params) -> Tensor:
        """Prior variances of the weights on the diagonal: (11, 11)."""
        return torch.diag(torch.from_numpy(np.append(self._room, CERTAIN)))

    def prior_weights(self) -> Tensor | None:
        """Prior mean of the weights: no payload, and one, (11,)."""
        return torch.from_numpy(np.append(np.zeros(PARAMETERS), 1.0))

    def initial(self, motion: Motion, tau: Tensor) -> dict[str, Tensor]:
        """No hyperparameters."""
        return {}


class PayloadRegressor(Regressor):
    """Features of `PayloadKernel`, one query at a time."""

    def __init__(self, kernel: PayloadKernel) -> None:
        self.n_joints, self.size = kernel.n_joints, PARAMETERS + 1
        self._kernel = kernel

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (11, n)."""
        out[:] = self._kernel.rows(motion[None])[0]
