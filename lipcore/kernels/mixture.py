"""The kernel of alternative arms: the difference between their torque and that of the first arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.arm_prior import Alternative, Arm
from lipcore.kernels.arrays import constant, reordered
from lipcore.kernels.base import LinearKernel, Params, Regressor, State
from lipcore.kernels.fast.arm import arm_differences
from lipcore.kernels.newton_euler import rigid_body_torque


class MixtureKernel(LinearKernel):
    """tau = Σ c_k δ_k with δ_k = τ_k − τ_0, the torque of arm k minus that of the first arm.

    τ_k = Y(θ_k) π_k + r_k ∘ ddq + P f_k, with `newton_euler.rigid_body_torque` and the drive's features; compiled. With
    c one of the K others or none, by their probabilities p, c has mean p and covariance C = diag p − p pᵀ = L Lᵀ. The
    sum then has the mean and the variance of the mixture of arms. The features are Lᵀ δ. Their weights L⁻¹ c, (K,), are
    independent with variance one, or a larger one if a few arms represent many.

    arm: linearised arm, with the drive's kinds and load; arms: the first arm and the others, K + 1; variance: of the
    weights. mixing: L, (K, K).
    """

    def __init__(self, arm: Arm, arms: Sequence[Alternative], variance: float = 1.0) -> None:
        self.n_joints, self.size, self._variance = arm.n_joints, len(arms) - 1, variance
        self._arm, self._each = arm, tuple(arms)
        shares = np.array([each.probability for each in arms[1:]])
        self.mixing = np.ascontiguousarray(np.linalg.cholesky(np.diag(shares) - np.outer(shares, shares)))
        self._mean = np.linalg.solve(self.mixing, shares)
        self._arms = (
            self.mixing,
            np.stack([each.geometry.constants for each in arms]),
            arms[0].geometry.gravity,
            np.stack([each.parameters for each in arms]),
            np.stack([np.concatenate([each.rotor[:, None], each.friction], axis=1) for each in arms]),
        )

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (K, n, N), see `LinearKernel.formula`."""
        arm, xp = self._arm, array_namespace(x.q)
        drive = xp.concat([x.ddq[None], arm.friction.formula(x)])  # (1 + f, N, n)
        torques = []
        for each in self._each:
            geometry = replace(each.geometry, gravity=self._each[0].geometry.gravity)
            bodies = rigid_body_torque(geometry, each.parameters, State.paired(x).ordered(arm.order))
            own = np.concatenate([each.rotor[:, None], each.friction], axis=1).T
            torques.append(reordered(bodies, arm.place) + (drive * constant(own[:, None], drive)).sum(0).T)
        differences = xp.stack([each - torques[0] for each in torques[1:]])
        return xp.tensordot(constant(self.mixing.T, differences), differences, axes=1)

    def regressor(self) -> Regressor:
        """Return the regressor that computes Φ for single queries."""
        return MixtureRegressor(self._arms, self._arm)

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (K,)."""
        return np.full(self.size, self._variance)

    def prior_weights(self) -> Array:
        """Return the prior mean of the weights, (K,)."""
        return self._mean

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return no hyperparameters: the kernel has none."""
        return {}


class MixtureRegressor(Regressor):
    """Features of `MixtureKernel` for single queries."""

    def __init__(self, arms: tuple[Array, Array, Array, Array, Array], arm: Arm) -> None:
        self.n_joints, self.size = arm.n_joints, len(arms[0])
        self._arms, self._order = arms, arm.order.astype(np.int64)
        self._drive = arm.friction.regressor

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (K, n)."""
        self.fill_many(motion[None], out[None], 0)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        rows = np.empty((len(motions), self.size, self.n_joints))
        arm_differences(*self._arms, self._order, motions, self._drive.linear(motions), rows)
        out[:, first : first + self.size] = rows
