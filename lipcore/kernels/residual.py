"""The torque that training has learnt beside the arm: near its motion only, and the same until the next training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import Params, TorqueKernel, on_last_diagonal
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.answer import pack
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.fast.residual import PANEL, pack_centres, residual_torque

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class JointResidual:
    """What is known of the residual of one joint, with r_c(x) = exp(−½ Σ_d (x_d − z_cd)² / ℓ_d²) at m centres z_c.

    The mean is Σ_c weights_c r_c(x), the variance is variance − |root (r_1, …, r_k)|².
    """

    lengthscales: Array
    """ℓ, (4 n,), in the units of `inputs`."""
    centres: Array
    """z, (m, 4 n)."""
    weights: Array
    """(m,) N·m."""
    root: Array
    """Lower triangular, (k, k) N·m, of the first k centres."""
    variance: float
    """Variance far from all centres, (N·m)²."""

    @classmethod
    def none(cls, n: int) -> JointResidual:
        """Return a residual of zero, for one of n joints."""
        return cls(np.ones(4 * n), np.zeros((0, 4 * n)), np.zeros(0), np.zeros((0, 0)), 0.0)

    @property
    def motion(self) -> Motion:
        """The motion at the centres."""
        return Motion(*np.ascontiguousarray(np.split(self.centres, 4, axis=1)[:3]))

    @property
    def triangle(self) -> Array:
        """The root row by row, down to the diagonal, flat."""
        return np.asarray(self.root[np.tril_indices(len(self.root))])

    @property
    def gram(self) -> Array:
        """Correlations r of all centres with each other, (m, m)."""
        return _near(self.centres, self.centres, self.lengthscales)


class ResidualKernel(TorqueKernel):
    """Torque of mean and variance as of its `JointResidual` in each joint; joints are independent.

    No sample changes it, and it has no hyperparameters.

    Example: with one centre at rest and no uncertainty left there.

    >>> joint = JointResidual(np.ones(4), np.zeros((1, 4)), np.array([2.0]), np.array([[0.5]]), 0.25)
    >>> rest, far = Motion(*np.zeros((3, 1, 1))), Motion(np.full((1, 1), 10.0), *np.zeros((2, 1, 1)))
    >>> kernel = ResidualKernel([joint])
    >>> [(float(kernel.mean(x)[0, 0].round(6)), float(kernel.variance({}, x)[0, 0, 0])) for x in (rest, far)]
    [(2.0, 0.0), (0.0, 0.25)]
    """

    def __init__(self, joints: list[JointResidual]) -> None:
        self.n_joints, self.joints = len(joints), joints
        padded = [np.pad(each.weights, (0, -len(each.weights) % LANES)) for each in joints]
        self._arrays = (
            np.stack([1 / each.lengthscales for each in joints]),
            np.concatenate([pack_centres(each.centres / each.lengthscales) for each in joints]),
            np.cumsum([0, *(len(each) // LANES for each in padded)]).astype(np.int64),
            np.concatenate(padded),
            np.concatenate([pack(each.root, 0, PANEL * LANES) for each in joints]),
            np.array([len(each.root) for each in joints], np.int64),
            self.prior,
            SIGN_WIDTH,
        )

    @property
    def prior(self) -> Array:
        """Variance of the torques far from the training's motion, (n,) (N·m)²."""
        return np.array([each.variance for each in self.joints])

    def fill_many(self, motions: Array, mean: Array, variance: Array) -> None:
        """Write the means and variances of N queries, (N, n) each. motions: (N, …, n), as of `Motion.arrays`."""
        residual_torque(*self._arrays, motions, mean, variance)

    def moments(self, x: Motion) -> tuple[Array, Array]:
        """Return means, N·m, and variances, (N·m)², of the torques at N instants, (N, n) each."""
        mean, variance = np.empty((2, *x.q.shape))
        self.fill_many(x.arrays(), mean, variance)
        return mean, variance

    def mean(self, x: Motion) -> Array:
        """Return the means of the torques, (N, n) N·m."""
        return self.moments(x)[0]

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the covariance of the torques at each sample, (N, n, n)."""
        return on_last_diagonal(self.moments(x)[1])

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return the covariance of all torques of x with those of y, (N n, M n)."""
        n, one, other = self.n_joints, residual_inputs(x), residual_inputs(y)
        out = np.zeros((len(x), n, len(y), n))
        for j, each in enumerate(self.joints):
            learnt = [each.root @ _near(each.centres[: len(each.root)], at, each.lengthscales) for at in (one, other)]
            out[:, j, :, j] = each.variance * _near(one, other, each.lengthscales) - learnt[0].T @ learnt[1]
        return out.reshape(len(x) * n, len(y) * n)

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the covariance of all torques of x with each other, (N n, N n), exactly symmetric."""
        gram = self.gram(params, x, x)
        return 0.5 * (gram + gram.T)

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return no derivatives: there are no hyperparameters."""
        return {}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return no hyperparameters."""
        return {}


def residual_inputs(motion: Motion) -> Array:
    """Return x = (q, dq, ddq, tanh(dq / SIGN_WIDTH)) of N instants, (N, 4 n)."""
    return np.concatenate([motion.q, motion.dq, motion.ddq, np.tanh(motion.dq / SIGN_WIDTH)], axis=1)


def _near(one: Array, other: Array, lengthscales: Array) -> Array:
    return np.asarray(np.exp(-0.5 * cdist(one / lengthscales, other / lengthscales, "sqeuclidean")))
