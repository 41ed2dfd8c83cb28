"""The torque prior of the drive: the joints' friction, linear in independent coefficients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.drive.terms import SHAPE_SPEEDS, SIGN_WIDTH, STRIBECK_SPEED, check_kinds, drive_terms
from lipcore.kernels.fast.drive import drive_queries, drive_query, drive_size, linear_features
from lipcore.kernels.fast.views import Memory
from lipcore.vocabulary import DRIVE_KINDS


class DriveKernel(LinearKernel):
    """Friction tau_i = Σ_k f_ik φ_k(dq_i, |τ_i|) with the terms φ of `lipcore.kernels.drive.terms`.

    The load τ is the torque that the bodies of `arm` need, `newton_euler.rigid_body_torque` at the arm's parameters: a
    function of the query, not of the weights.

    Weights: (f n,), joint by joint; `terms` contains the names of a joint's f. Hyperparameter: `friction.log_std`
    (n, f).

    n_joints: n; kinds: of the drive, beyond viscous, Coulomb and offset; arm: its bodies, for the kind `load`.
    """

    def __init__(self, n_joints: int, kinds: Sequence[str] = (), arm: Arm | None = None) -> None:
        self.n_joints, self.kinds, self.arm = n_joints, check_kinds(kinds), arm
        if "load" in self.kinds and arm is None:
            raise ValueError("drive kind 'load' needs an arm")
        self.terms = drive_terms(self.kinds)

    def regressor(self) -> DriveRegressor:
        """Return the regressor that computes the terms of single queries."""
        return DriveRegressor(self)

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (f n,)."""
        log_std = params["friction.log_std"]
        return array_namespace(log_std).exp(2 * log_std).reshape(-1)

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Return the derivatives by the logarithms of the standard deviations, given those by the variances, (f n,)."""
        log_std = params["friction.log_std"]
        return {"friction.log_std": 2 * np.exp(2 * log_std) * slopes.reshape(log_std.shape)}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start every term with a tenth of each joint's torque at the term's usual size: log std (n, f)."""
        usual = 0.1 * np.sqrt(np.square(tau).mean(0)).clip(1e-6)
        size = np.sqrt(np.square(self.by_joint(motion)).mean(axis=0)).clip(1e-3)  # (n, f)
        size[:, 1:3] = 1.0  # the sign and the offset, whatever the motion
        return {"friction.log_std": np.log(usual[:, None] / size)}

    def by_joint(self, motion: Motion) -> Array:
        """Return each joint's terms, (N, n, f)."""
        return self.regressor().linear(motion.arrays())[:, :, 1:]


class DriveRegressor(Regressor):
    """Terms of `DriveKernel` for single queries, compiled."""

    def __init__(self, kernel: DriveKernel) -> None:
        self.n_joints = n = kernel.n_joints
        self._terms = len(kernel.terms)
        self.size = self._terms * n
        arm = kernel.arm if "load" in kernel.kinds else None
        self._order = np.arange(n) if arm is None else arm.order.astype(np.int64)
        self._kinds = np.array([int(kind in kernel.kinds) for kind in DRIVE_KINDS])
        self._constants = np.array([SIGN_WIDTH, STRIBECK_SPEED, *SHAPE_SPEEDS])
        bodies = () if arm is None else (arm.geometry.constants, arm.geometry.gravity, arm.parameters)
        self._memory = Memory(bodies, n if arm is None else drive_size(n))

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (f n, n)."""
        drive_query(self._memory.flat, self._order, self._kinds, self._constants, motion, out)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        drive_queries(
            self._memory.flat, self._order, self._kinds, self._constants, motions, out, first, first + self.size
        )

    def linear(self, motions: Array) -> Array:
        """Return ddq and each joint's terms at N queries, (N, n, 1 + f). motions: (N, 3, n)."""
        out = np.empty((len(motions), self.n_joints, 1 + self._terms))
        linear_features(self._memory.flat, self._order, self._kinds, self._constants, motions, out)
        return out
