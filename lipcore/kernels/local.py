"""A local correction near the training motion, for the torque that rigid bodies and friction do not explain."""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace
from scipy.spatial.distance import cdist

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import Cross, PairKernel, Params, State, on_diagonal
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.local import local_cross
from lipcore.kernels.independent import per_joint, power, spread


class LocalKernel(PairKernel):
    """k_ij = δ_ij s_i² exp(−½ Σ_d (x_d − x'_d)² / ℓ_d²) on x = (q, dq, ddq, tanh(dq / SIGN_WIDTH)).

    Joints share the lengthscales and nothing else. Hyperparameters: `local.log_scale` (n,), log s_i² in (N·m)²;
    `local.log_lengthscales` (4 n,), log ℓ_d in the units of x.

    Example: at the sample itself the covariance is s²; ten lengthscales away it is zero.

    >>> x = Motion(*np.zeros((3, 1, 1)))
    >>> y = Motion(np.full((1, 1), 10.0), *np.zeros((2, 1, 1)))
    >>> params = {"local.log_scale": np.log([4.0]), "local.log_lengthscales": np.zeros(4)}
    >>> [float(LocalKernel(1).gram(params, x, each)[0, 0].round(6)) for each in (x, y)]
    [4.0, 0.0]
    """

    def __init__(self, n_joints: int) -> None:
        self.n_joints = n_joints

    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²; zero for i ≠ j."""
        xp = array_namespace(x.q)
        signs = xp.tanh(x.v / SIGN_WIDTH) - xp.tanh(y.v / SIGN_WIDTH)
        squares = xp.square(xp.concat([x.q - y.q, x.v - y.v, x.a - y.a, signs]))
        exponent = xp.tensordot(xp.exp(-2 * params["local.log_lengthscales"]), squares, axes=1)[None]
        return on_diagonal(xp.exp(per_joint(params["local.log_scale"], exponent) - 0.5 * exponent))

    def cross(self, params: Params, inducing: Motion) -> Cross:
        """Return the compiled covariances of single queries with the inducing samples and with themselves."""
        return _LocalCross(params, inducing)

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Start with the full power of tau, (N, n), and with 0.3 of every input's spread, times √(4 n).

        Squared distances add up over 4 n inputs. The lengthscales are a fifth of the distance of two random samples, so
        that all samples are far from unknown motion.
        """
        lengths = 0.3 * (4 * self.n_joints) ** 0.5 * np.concatenate([spread(each) for each in _inputs(motion)])
        return {"local.log_scale": np.log(power(tau)), "local.log_lengthscales": np.log(lengths)}


def scaled(params: Params, motion: Motion) -> Array:
    """Return the inputs divided by their lengthscales, (N, 4 n). params: `local.log_lengthscales`."""
    return np.concatenate(_inputs(motion), axis=1) * np.exp(-params["local.log_lengthscales"])


def nearness(params: Params, x: Motion) -> Array:
    """Return the correlation of each joint's correction between all samples, (N, N).

    params: `local.log_lengthscales`.
    """
    inputs = scaled(params, x)
    return np.asarray(np.exp(-0.5 * cdist(inputs, inputs, "sqeuclidean")))


class _LocalCross(Cross):
    """`Cross` of the local kernel, with one distance per sample for all joints."""

    def __init__(self, params: Params, inducing: Motion) -> None:
        self.size, self.n_joints = len(inducing), inducing.n_joints
        self._rate, self._scale = np.exp(-params["local.log_lengthscales"]), np.exp(params["local.log_scale"])
        self._anchors = scaled(params, inducing)

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries; see `Cross.fill_many`."""
        local_cross(self._anchors, self._rate, self._scale, SIGN_WIDTH, motions, out)


def _inputs(motion: Motion) -> list[Array]:
    return [motion.q, motion.dq, motion.ddq, np.tanh(motion.dq / SIGN_WIDTH)]
