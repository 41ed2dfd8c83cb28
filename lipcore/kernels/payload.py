"""The kernel of a payload: a body on the last link of an arm, torque linear in its ten parameters."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.compiled.arm import arm_energies, arm_masses
from lipcore.kernels.compiled.arm_recursion import PARAMETERS, WORK
from lipcore.kernels.compiled.payload import NEAR, payload_features, payload_queries, payload_query, payload_size
from lipcore.kernels.compiled.views import Memory

CERTAIN = 1e-12
"""Variance of the weight that is known to be one."""


class PayloadKernel(LinearKernel):
    """tau = (b(θ) + ∂b/∂θ δ) π − (∂b/∂θ δ) π̄ around a payload π̄ and a step δ of the geometry θ, b = ∂(Y π)/∂π.

    Where the geometry is learnt, torque is bilinear in a step δθ of it and in π: b(θ) π + (∂b/∂θ δθ) π, whose
    derivative with respect to δθ at π̄ belongs to the arm's own weights, which are linearised with the payload in their
    parameters (`ArmKernel`); this is the rest. All is at θ and linear in δ, as the arm's own weights are: torque leaves
    directions open along which they are large, while their effects cancel to first order only.

    Weights: π (10,), and one that is known to be 1. arm: θ and the order of its joints; step: δ, (g,) rad and m;
    payload: π̄, (10,); room: prior variance of π, (10,).
    """

    def __init__(self, arm: Arm, step: Array, payload: Array, room: Array) -> None:
        self.n_joints, self.payload, self._room = arm.n_joints, np.array(payload), np.array(room)
        self.order, self.gravity = arm.order.astype(np.int64), arm.geometry.gravity
        self._geometry, self._step = arm.geometry, step
        beside = [arm.geometry.moved_constants(side * step) for side in (NEAR, -NEAR)] if arm.steps else []
        self.constants = np.stack([arm.geometry.constants, *beside])
        first = PARAMETERS * int(arm.order[-1])
        self._last = slice(first, first + PARAMETERS)

    def rows(self, motions: Array) -> Array:
        """Φᵀ of N motions (N, 3, n): (N, 11, n)."""
        work = np.empty((payload_size(self.n_joints), WORK))
        out = np.empty((len(motions), PARAMETERS + 1, self.n_joints))
        payload_features(self.constants, self.gravity, self.payload, self.order, motions, work, out)
        return out

    def bend(self, motions: Array) -> Array:
        """What b(θ + δ) π̄ is more than linear in δ, at N motions (N, 3, n): (N, n) N·m."""
        out = np.empty((len(motions), PARAMETERS * self.n_joints, self.n_joints))
        arm_masses(self._ahead, self.gravity, self.order, motions, out)
        more = out[:, self._last] - self.rows(motions)[:, :PARAMETERS]
        return np.asarray(np.tensordot(more, self.payload, axes=(1, 0)))

    @cached_property
    def _ahead(self) -> Array:
        """The constants of θ + δ."""
        return self._geometry.moved_constants(self._step) if len(self.constants) > 1 else self.constants[0]

    def features(self, x: Motion) -> Tensor:
        """Φ at each sample: (N, n, 11)."""
        return torch.from_numpy(np.ascontiguousarray(self.rows(x.arrays()).transpose(0, 2, 1)))

    def energy_features(self, x: Motion) -> Tensor:
        """Kinetic and potential energy per unit of each weight: (N, 2, 11) J."""
        none, sides = np.zeros((self.n_joints, PARAMETERS)), []
        for constants in self.constants:
            out = np.empty((len(x), 2, (PARAMETERS + 1) * self.n_joints))
            arm_energies(constants, self.gravity, none, self.order, x.arrays(), out)
            sides.append(out[..., self._last])
        change = (sides[1] - sides[2]) / (2 * NEAR) if len(sides) > 1 else np.zeros_like(sides[0])
        known = -(change @ self.payload)[..., None]
        return torch.from_numpy(np.concatenate([sides[0] + change, known], axis=2))

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
    """Features of `PayloadKernel`, compiled."""

    def __init__(self, kernel: PayloadKernel) -> None:
        self.n_joints, self.size = kernel.n_joints, PARAMETERS + 1
        self._sides, self._order = len(kernel.constants), kernel.order
        fixed = kernel.constants, kernel.gravity, kernel.payload
        self._memory = Memory(fixed, payload_size(kernel.n_joints) * WORK)

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (11, n)."""
        payload_query(self._memory.flat, self._sides, self._order, motion, out)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        payload_queries(self._memory.flat, self._sides, self._order, motions, out, first)
