"""The kernel of a payload: a body on the last link of an arm, torque linear in its ten parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.compiled.arm import arm_energies, arm_masses
from lipcore.kernels.compiled.arm_recursion import PARAMETERS

CERTAIN = 1e-12
"""Variance of the weight that is known to be one."""
NEAR = 1e-4
"""Share of a step over which differences stand for the derivative along it."""


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
        self.n_joints, self._payload, self._room = arm.n_joints, np.array(payload), np.array(room)
        self._order, self._gravity = arm.order.astype(np.int64), arm.geometry.gravity
        self._constants = arm.geometry.constants
        self._ahead = arm.geometry.moved(step).constants if arm.steps else self._constants
        self._beside = tuple(arm.geometry.moved(side * step).constants for side in (NEAR, -NEAR)) if arm.steps else ()
        first = PARAMETERS * int(arm.order[-1])
        self._last = slice(first, first + PARAMETERS)

    def rows(self, motions: Array) -> Array:
        """Φᵀ of N motions (N, 3, n): (N, 11, n)."""
        return self._around(lambda constants: self._masses(constants, motions))

    def bend(self, motions: Array) -> Array:
        """What b(θ + δ) π̄ is more than linear in δ, at N motions (N, 3, n): (N, n) N·m."""
        straight = self.rows(motions)[:, :PARAMETERS]
        return np.asarray(np.tensordot(self._masses(self._ahead, motions) - straight, self._payload, axes=(1, 0)))

    def _masses(self, constants: Array, motions: Array) -> Array:
        """∂τ/∂π of the last link: (N, 10, n)."""
        out = np.empty((len(motions), PARAMETERS * self.n_joints, self.n_joints))
        arm_masses(constants, self._gravity, self._order, motions, out)
        return out[:, self._last]

    def _around(self, last: Callable[[Array], Array]) -> Array:
        """Features (N, 11, …) from those of the last link's parameters at some constants, (N, 10, …)."""
        here = last(self._constants)
        if not self._beside:
            return np.concatenate([here, np.zeros_like(here[:, :1])], axis=1)
        ahead, behind = (last(each) for each in self._beside)
        change = (ahead - behind) / (2 * NEAR)
        known = np.tensordot(change, self._payload, axes=(1, 0))
        return np.concatenate([here + change, -known[:, None]], axis=1)

    def features(self, x: Motion) -> Tensor:
        """Φ at each sample: (N, n, 11)."""
        return torch.from_numpy(np.ascontiguousarray(self.rows(x.arrays()).transpose(0, 2, 1)))

    def energy_features(self, x: Motion) -> Tensor:
        """Kinetic and potential energy per unit of each weight: (N, 2, 11) J."""
        none = np.zeros((self.n_joints, PARAMETERS))

        def last(constants: Array) -> Array:
            out = np.empty((len(x), 2, (PARAMETERS + 1) * self.n_joints))
            arm_energies(constants, self._gravity, none, self._order, x.arrays(), out)
            return out[..., self._last].transpose(0, 2, 1)

        return torch.from_numpy(np.ascontiguousarray(self._around(last).transpose(0, 2, 1)))

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
