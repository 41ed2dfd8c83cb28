"""The baselines of TR2023-063 with independent joints: squared exponential and geometrically inspired.

A. Dalla Libera and R. Carli, "A data-efficient geometrically inspired polynomial kernel for robot inverse dynamics",
IEEE RA-L 2020: rigid-body torques are of degree one in (1, ddq_a, dq_a dq_b) and of degree two in each joint's
(cos q_b, sin q_b), or q_b if it is prismatic. Their multiplicative polynomial kernel of degree d is a product of d
linear kernels, each with its own parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from array_api_compat import array_namespace

from lipcore.data.motion import Array, Motion, check_joint_types
from lipcore.kernels.arrays import on_diagonal
from lipcore.kernels.base import PairKernel, Params, State
from lipcore.vocabulary import JointType


class SquaredExponentialKernel(PairKernel):
    """k_i = s_i² exp(−½ Σ_d (x_d − x'_d)² / ℓ_{i,d}²) on x = (q, dq, ddq), independent for each joint i.

    Hyperparameters: `se.log_scale` (n,), log s_i² in (N·m)²; `se.log_lengthscales` (n, 3 n), log ℓ_{i,d} in the units
    of q, dq and ddq.
    """

    def __init__(self, n_joints: int) -> None:
        self.n_joints = n_joints

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²; zero for i ≠ j."""
        xp = array_namespace(x.q)
        squares = xp.square(xp.concat([x.q - y.q, x.v - y.v, x.a - y.a]))
        exponent = xp.tensordot(xp.exp(-2 * params["se.log_lengthscales"]), squares, axes=1)
        return on_diagonal(xp.exp(per_joint(params["se.log_scale"], exponent) - 0.5 * exponent))

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with the measured power and the spread of every input, times √(3 n) because squared distances add up.

        The lengthscales of dq and ddq have a minimum. It is lower for a joint that bears no weight: the torque of such
        a joint is small already at the accelerations in the data.
        """
        n, rms = self.n_joints, np.sqrt(power(tau))
        lengthscales = np.concatenate([spread(motion.q), spread(motion.dq), spread(motion.ddq)]) * (3 * n) ** 0.5
        # a joint with less than 5 % of the torque of the joints behind it bears inertia rather than weight
        weight = np.minimum(rms / (0.05 * largest_behind(rms)), 1.0)
        factors = np.stack([np.ones_like(weight), np.sqrt(weight), weight], axis=1)
        # Minimum lengthscales in rad, rad/s and rad/s² (m): gravity over a turn, and the speeds and accelerations at
        # which inertia needs as much torque as weight. Motion within a small range does not determine shorter
        # lengthscales.
        least = np.repeat(factors * (2.0, 4.0, 40.0), n, axis=1)
        return {
            "se.log_scale": np.log(power(tau)),
            "se.log_lengthscales": np.log(np.maximum(lengthscales, least)),
        }

    def prior_std(self) -> dict[str, float]:
        """Return the standard deviations of scales and lengthscales around their start.

        They are below the default: motion determines few of the 3 n lengthscales of a joint.
        """
        return {"se.log_scale": 2.0, "se.log_lengthscales": 1.0}


def per_joint(values: Array, like: Array) -> Array:
    """Reshape one number per joint, (n,), to broadcast with `like`, (n, *batch)."""
    return values.reshape((-1,) + (1,) * (like.ndim - 1))


def spread(values: Array) -> Array:
    """Return the standard deviation of each joint's values, (N, n) to (n,).

    It is at least 1e-3, and at least a tenth of the largest one, because some joints stand still.
    """
    std = values.std(0)
    return np.maximum(std, max(0.1 * std.max(), 1e-3))


def power(tau: Array) -> Array:
    """Return the mean square torque of each joint, (N, n) to (n,) (N·m)², always above zero."""
    return np.square(tau).mean(0).clip(1e-12)


def largest_behind(values: Array) -> Array:
    """Return the largest value of each joint and the joints after it, (n,): a joint carries those after it."""
    return np.maximum.accumulate(values[::-1])[::-1]


FACTOR_LOGITS = (0.0, -4.0)
"""Starting logits of a joint's two position factors.

Gravity is of degree one, so the second factor is nearly constant. Equal logits would have equal gradients and stay
equal.
"""
DEGREE = len(FACTOR_LOGITS)


class GeometricallyInspiredKernel(PairKernel):
    """k_i = [c_i + Σ_a w_{i,a} ddq_a ddq'_a + (Σ_a u_{i,a} dq_a dq'_a)²] Π_b p_{i,b,1} p_{i,b,2} for each joint i.

    p = σ + α cos q cos q' + β sin q sin q' for revolute joints, and σ + β + α q q' for prismatic joints. σ + α + β = 1:
    the scale is in c, w and u. The square weighs dq_a dq_b by u_a u_b; the paper gives every product its own weight.

    The weights are pooled, log w_{i,a} = 2 (r_i + m_a) + δ_{i,a} and log u_{i,a} = ½ log w_{i,a} + s_i + ε_{i,a}:
    inertia is large if both joints bear much, and velocity products have the size of an inertia. The position factors
    are pooled too: their logits are those of joint b, the same for all torques, plus a deviation of joint i. Joints
    share only hyperparameters.

    Hyperparameters:

    - `gip.log_constant` (n,): log c;
    - `gip.log_row` (n,): r;
    - `gip.log_column` (n,): m;
    - `gip.log_acceleration` (n, n): δ;
    - `gip.log_speed` (n,): s;
    - `gip.log_velocity` (n, n): ε;
    - `gip.logits` (n, 2, 2): joint b × factor × (α, β);
    - `gip.logits_deviation` (n, n, 2, 2): joint i × joint b × factor × (α, β).
    """

    def __init__(self, joint_types: Sequence[str]) -> None:
        self.joint_types: tuple[JointType, ...] = check_joint_types(joint_types)
        self.n_joints = len(self.joint_types)

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²; zero for i ≠ j."""
        log_w, log_u = self._log_weights(params)
        xp = array_namespace(x.q)
        acceleration = xp.tensordot(xp.exp(log_w), x.a * y.a, axes=1)
        velocity = xp.tensordot(xp.exp(log_u), x.v * y.v, axes=1)
        constant = per_joint(xp.exp(params["gip.log_constant"]), velocity)
        dynamic = constant + acceleration + xp.square(velocity)
        logits = params["gip.logits"] + params["gip.logits_deviation"]
        return on_diagonal(dynamic * self._position(logits, x.q, y.q))

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with a constant that gives the measured power, and with the inertia of a typical arm of this torque."""
        n, zeros = self.n_joints, np.zeros
        logits = zeros((n, DEGREE, 2)) + np.array(FACTOR_LOGITS)[:, None]
        position = self._position(np.broadcast_to(logits, (n, n, DEGREE, 2)), motion.q.T, motion.q.T).mean(1)
        # w is the square of an inertia, 0.05 kg·m² per N·m; each joint contributes half of its logarithm
        half = 0.5 * np.log(0.05 * largest_behind(np.sqrt(power(tau))))
        return {
            "gip.log_constant": np.log(power(tau) / position),
            "gip.log_row": half,
            "gip.log_column": half.copy(),
            "gip.log_acceleration": zeros((n, n)),
            "gip.log_speed": zeros(n),
            "gip.log_velocity": zeros((n, n)),
            "gip.logits": logits,
            "gip.logits_deviation": zeros((n, n, DEGREE, 2)),
        }

    def prior_std(self) -> dict[str, float]:
        """Return how far the weights and shares may differ from their pattern, and the pattern from its start.

        Tuned on fits to simulated data of a Panda. With narrower logits, a torque cannot ignore the joints that do not
        turn it.
        """
        return {
            "gip.log_constant": 2.0,
            "gip.log_row": 1.0,
            "gip.log_column": 0.5,
            "gip.log_acceleration": 0.5,
            "gip.log_speed": 1.0,
            "gip.log_velocity": 0.5,
            "gip.logits": 1.0,
            "gip.logits_deviation": 1.0,
        }

    def _log_weights(self, params: Params) -> tuple[Array, Array]:
        """Return log w and log u, each (n, n), joint i × joint a."""
        pattern = params["gip.log_row"][:, None] + params["gip.log_column"]
        log_w = 2 * pattern + params["gip.log_acceleration"]
        return log_w, 0.5 * log_w + params["gip.log_speed"][:, None] + params["gip.log_velocity"]

    def _position(self, logits: Array, q: Array, q2: Array) -> Array:
        """Return Π_b p_{i,b,1} p_{i,b,2} of every joint i, (n, *batch)."""
        xp = array_namespace(q)
        first, second = xp.cos(q) * xp.cos(q2), xp.sin(q) * xp.sin(q2)
        shares = _position_shares(logits)
        total = xp.ones_like(first)
        for b, kind in enumerate(self.joint_types):
            one, two = (first[b], second[b]) if kind == "revolute" else (q[b] * q2[b], xp.ones_like(first[b]))
            for factor in range(DEGREE):
                sigma, alpha, beta = (per_joint(shares[:, b, factor, each], first) for each in range(3))
                total = total * (sigma + alpha * one + beta * two)
        return total


def _position_shares(logits: Array) -> Array:
    """Return the shares (σ, α, β) from the logits of α and β: (..., 2) to (..., 3)."""
    xp = array_namespace(logits)
    every = xp.concat([xp.zeros_like(logits[..., :1]), logits], axis=-1)
    powers = xp.exp(every - xp.max(every, axis=-1, keepdims=True))
    return powers / xp.sum(powers, axis=-1, keepdims=True)
