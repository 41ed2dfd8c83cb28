"""The kernel of a payload: a body on the last link of an arm, with torque linear in its ten parameters."""

from __future__ import annotations

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.arrays import reordered
from lipcore.kernels.base import LinearKernel, Params, Regressor, State
from lipcore.kernels.fast.arm import arm_energies
from lipcore.kernels.fast.arm_recursion import PARAMETERS
from lipcore.kernels.fast.payload import payload_queries, payload_query, payload_size
from lipcore.kernels.fast.views import Memory
from lipcore.kernels.newton_euler import rigid_body_features


class PayloadKernel(LinearKernel):
    """tau = b(θ) π, b = ∂(Y π)/∂π of an arm's last link.

    Y π is `newton_euler.rigid_body_torque`; compiled code computes b, its derivative.

    If the geometry θ is learnt, the change of the payload's torque with a step of θ belongs to the arm's own weights:
    they are linearised with the payload in their parameters (`ArmKernel`).

    Weights: π (10,). arm: θ and the order of its joints; room: prior variances of π, (10,).
    """

    def __init__(self, arm: Arm, room: Array) -> None:
        self.n_joints, self._room = arm.n_joints, np.array(room)
        self.order, self.gravity = arm.order.astype(np.int64), arm.geometry.gravity
        self.constants, self._geometry = arm.geometry.constants, arm.geometry
        self._none = np.zeros((arm.n_joints, PARAMETERS))
        first = PARAMETERS * int(arm.order[-1])
        self._last = slice(first, first + PARAMETERS)

    def energy_features(self, x: Motion) -> Array:
        """Return the kinetic and the potential energy per unit of each weight, (N, 2, 10) J."""
        out = np.empty((len(x), 2, (PARAMETERS + 1) * self.n_joints))
        arm_energies(self.constants, self.gravity, self._none, self.order, x.arrays(), out)
        return np.ascontiguousarray(out[..., self._last])

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (10, n, N), see `LinearKernel.formula`."""
        masses, _ = rigid_body_features(self._geometry, self._none, State.paired(x).ordered(self.order))
        return reordered(masses[-PARAMETERS:], np.argsort(self.order), 1)

    def regressor(self) -> Regressor:
        """Return the regressor that computes the same features for single queries."""
        return PayloadRegressor(self)

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (10,)."""
        return self._room

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return no hyperparameters: the kernel has none."""
        return {}


class PayloadRegressor(Regressor):
    """Features of `PayloadKernel` for single queries."""

    def __init__(self, kernel: PayloadKernel) -> None:
        self.n_joints, self.size = kernel.n_joints, PARAMETERS
        self._order = kernel.order
        self._memory = Memory((kernel.constants, kernel.gravity), payload_size(kernel.n_joints))

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (10, n)."""
        payload_query(self._memory.flat, self._order, motion, out)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        payload_queries(self._memory.flat, self._order, motions, out, first)
