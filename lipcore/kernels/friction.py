"""Joint friction: viscous, Coulomb and offset torque, and additional friction at low speed.

The joints are independent.
"""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.fast.friction import friction_queries, friction_query

SIGN_WIDTH = 0.02
"""Velocity over which the Coulomb sign changes, rad/s (m/s): tanh(dq / width) avoids a jump at standstill."""
STRIBECK_SPEED = 0.1
"""Speed at which the additional friction of slow joints has decayed to exp(−1), rad/s (m/s)."""
FRICTION_TERMS = ("viscous", "coulomb", "offset")


def friction_terms(stribeck: bool) -> tuple[str, ...]:
    """Return the names of a joint's features: three, or four with `stribeck`. The fourth decays with speed."""
    return (*FRICTION_TERMS, "stribeck") if stribeck else FRICTION_TERMS


def friction_features(dq: Array, stribeck: bool = False) -> Array:
    """Return [dq, smoothed sign(dq), 1], (3 or 4, *).

    With `stribeck` the fourth feature is that sign times exp(−(dq / STRIBECK_SPEED)²).
    """
    sign = np.tanh(dq / SIGN_WIDTH)
    slow = [sign * np.exp(-((dq / STRIBECK_SPEED) ** 2))] if stribeck else []
    return np.stack([dq, sign, np.ones_like(dq), *slow])


class FrictionKernel(LinearKernel):
    """Linear friction model tau_i = f_v dq_i + f_c sign(dq_i) + f_o with independent Gaussian weights.

    With `stribeck`, f_s sign(dq_i) exp(−(dq_i / STRIBECK_SPEED)²) is added. Weights: (f n,), joint by joint, f = 3 or 4
    each; `terms` contains their names. Hyperparameter: `friction.log_std` (n, f).
    """

    def __init__(self, n_joints: int, stribeck: bool = False) -> None:
        self.n_joints, self.stribeck = n_joints, stribeck
        self.terms = friction_terms(stribeck)

    def features(self, x: Motion) -> Array:
        """Return each joint's features in its own row, (N, n, f n)."""
        n = self.n_joints
        features = friction_features(x.dq, self.stribeck).transpose(1, 2, 0)  # (N, n, f)
        out, joints = np.zeros((len(x), n, n, len(self.terms))), np.arange(n)
        out[:, joints, joints] = features
        return out.reshape(len(x), n, -1)

    def regressor(self) -> Regressor:
        """Return the regressor that computes the same features for single queries."""
        return FrictionRegressor(self.n_joints, len(self.terms))

    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, (f n,)."""
        log_std = params["friction.log_std"]
        return array_namespace(log_std).exp(2 * log_std).reshape(-1)

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Return the derivatives by the logarithms of the standard deviations, given those by the variances, (f n,)."""
        log_std = params["friction.log_std"]
        return {"friction.log_std": 2 * np.exp(2 * log_std) * slopes.reshape(log_std.shape)}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start every feature with a tenth of each joint's torque at the joint's usual speed: log std (n, f)."""
        usual, speed = (np.sqrt(np.square(each).mean(0)) for each in (tau, motion.dq))
        usual, speed = 0.1 * usual.clip(1e-6), speed.clip(1e-3)
        return {"friction.log_std": np.log(np.stack([usual / speed, *[usual] * (len(self.terms) - 1)], axis=1))}


class FrictionRegressor(Regressor):
    """Features of `FrictionKernel` for single queries, compiled."""

    def __init__(self, n_joints: int, terms: int) -> None:
        self.n_joints, self.size = n_joints, terms * n_joints

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query, (f n, n)."""
        friction_query(motion, SIGN_WIDTH, STRIBECK_SPEED, out)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        friction_queries(motions, SIGN_WIDTH, STRIBECK_SPEED, out, first, first + self.size)
