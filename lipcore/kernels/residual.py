"""The torque beside the arm that is learnt near the motion of the training only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arrays import constant, on_last_diagonal
from lipcore.kernels.base import LinearKernel, Params, Regressor
from lipcore.kernels.drive.terms import SIGN_WIDTH
from lipcore.kernels.fast.answer import pack
from lipcore.kernels.fast.lanes import LANES
from lipcore.kernels.fast.residual import pack_centres, residual_torque
from lipcore.kernels.fast.triangles import HEIGHT

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class JointResidual:
    """The residual of one joint, with r_c(x) = exp(−½ Σ_d (x_d / ℓ_d − z_cd)²) at m centres z_c.

    Its prior mean is Σ_c weights_c r_c(x), what the training has learnt at all centres. Its features are φ = root (r_1,
    …, r_k), of the first k centres. They leave the variance (variance − |φ|²) (1 − taken max_c r_c(x)²). If the torque
    at a centre c is known, that at x has 1 − r_c(x)² of its variance.
    """

    lengthscales: Array
    """ℓ, (4 n,), in the units of `inputs`."""
    centres: Array
    """z, (m, 4 n), of float32 numbers: half the memory to read for each query."""
    weights: Array
    """(m,) N·m."""
    root: Array
    """Lower triangular, (k, k) N·m, of the first k centres."""
    variance: float
    """Variance without data, (N·m)²."""
    taken: float
    """Share of what the features leave that the training has learnt at the centres, 0 to 1."""
    fast_weights: Array
    """`weights` if only the first f centres are used, (f,) N·m, k ≤ f ≤ m."""
    fast_taken: float
    """`taken` if only these are used."""

    @classmethod
    def none(cls, n: int) -> JointResidual:
        """Return a residual of zero, for one of n joints."""
        return cls(np.ones(4 * n), np.zeros((0, 4 * n)), np.zeros(0), np.zeros((0, 0)), 0.0, 0.0, np.zeros(0), 0.0)

    def near(self, inputs: Array) -> Array:
        """Return r_c(x) at N instants, (m, N). inputs: `residual_inputs`, of any library."""
        xp = array_namespace(inputs)
        x, z = (inputs / constant(self.lengthscales, inputs)).T, constant(self.centres.astype(np.float64), inputs)
        distances = sum((x[d] - z[:, d : d + 1]) ** 2 for d in range(len(x)))
        return xp.exp(-0.5 * distances)

    @property
    def fast(self) -> JointResidual:
        """The residual of the first f centres only."""
        centres = self.centres[: len(self.fast_weights)]
        return replace(self, centres=centres, weights=self.fast_weights, taken=self.fast_taken)

    @property
    def triangle(self) -> Array:
        """The root row by row, down to the diagonal, flat."""
        return np.asarray(self.root[np.tril_indices(len(self.root))])


class ResidualKernel(LinearKernel):
    """Gaussian processes on the residuals of n joints, independent of each other: what an arm and its drives leave.

    The weights of the features, one joint's after another's, are independent with variance one. The kernel has no
    hyperparameters.

    Example: with one centre at rest, and one feature.

    >>> two = np.array([2.0])
    >>> joint = JointResidual(np.ones(4), np.zeros((1, 4)), two, np.array([[0.5]]), 0.25, 0.0, two, 0.0)
    >>> rest, far = Motion(*np.zeros((3, 1, 1))), Motion(np.full((1, 1), 10.0), *np.zeros((2, 1, 1)))
    >>> kernel = ResidualKernel([joint])
    >>> [(float(kernel.mean(x)[0, 0].round(6)), float(kernel.beyond(x)[0, 0])) for x in (rest, far)]
    [(2.0, 0.0), (0.0, 0.25)]
    """

    def __init__(self, joints: list[JointResidual]) -> None:
        self.n_joints, self.joints = len(joints), joints
        padded = [np.pad(each.weights, (0, -len(each.weights) % LANES)) for each in joints]
        self.sizes = np.array([len(each.root) for each in joints], np.int64)
        self._arrays = (
            np.stack([1 / each.lengthscales for each in joints]),
            np.concatenate([pack_centres(each.centres) for each in joints]),
            np.cumsum([0, *(len(each) // LANES for each in padded)]).astype(np.int64),
            np.concatenate(padded),
            np.concatenate([pack(each.root, 0, HEIGHT) for each in joints]),
            self.sizes,
            self.prior,
            np.array([each.taken for each in joints]),
            SIGN_WIDTH,
        )

    @cached_property
    def fast(self) -> ResidualKernel:
        """The kernel with the same features and fewer centres."""
        return ResidualKernel([each.fast for each in self.joints])

    @property
    def prior(self) -> Array:
        """Variance of the torques without data, (n,) (N·m)²."""
        return np.array([each.variance for each in self.joints])

    def of_joint(self, joint: int) -> Indices:
        """Return the places of the weights of a joint's features."""
        return self.sizes[:joint].sum() + np.arange(self.sizes[joint])

    def fill_all(self, motions: Array, features: Array, first: int, mean: Array, beyond: Array) -> None:
        """Write what `residual_torque` computes of N queries. motions: (N, …, n), as of `Motion.arrays`."""
        residual_torque(*self._arrays, motions, features, first, mean, beyond)

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (p, n, N), see `LinearKernel.formula`."""
        return self.formulas(x)[0]

    def formulas(self, x: Motion) -> tuple[Array, Array, Array]:
        """Return what `fill_all` writes, in the array API: Φᵀ (p, n, N), the mean and the variance beyond, (n, N)."""
        inputs = residual_inputs(x)
        xp, parts, means, left = array_namespace(inputs), [], [], []
        for joint, each in enumerate(self.joints):
            near = each.near(inputs)  # (m, N)
            mean = beyond = xp.zeros_like(inputs[:, 0])
            learnt = xp.zeros((0, *mean.shape), dtype=mean.dtype)
            if len(each.centres):
                mean = xp.tensordot(constant(each.weights, near), near, axes=1)
                learnt = xp.tensordot(constant(each.root, near), near[: len(each.root)], axes=1)
                nearest = xp.max(near, axis=0)
                open_ = xp.clip(each.variance - (learnt * learnt).sum(0), 0.0, None)
                beyond = open_ * (1.0 - each.taken * nearest * nearest)
            means.append(mean)
            left.append(beyond)
            others = xp.zeros_like(learnt)
            parts.append(xp.stack([learnt if k == joint else others for k in range(self.n_joints)], axis=1))
        return xp.concat(parts), xp.stack(means), xp.stack(left)

    def regressor(self) -> Regressor:
        """Return the regressor of all features."""
        return _ResidualRegressor(self)

    def variances(self, params: Params) -> Array:
        """Return ones, (p,)."""
        return np.ones(int(self.sizes.sum()))

    def mean(self, x: Motion) -> Array:
        """Return the prior mean of the torques, (N, n) N·m."""
        return self._moments(x)[0]

    def beyond(self, x: Motion) -> Array:
        """Return the prior variance of the torques that the features leave, (N, n) (N·m)²."""
        return self._moments(x)[1]

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the prior covariance of the torques at each sample, (N, n, n)."""
        return super().variance(params, x) + on_last_diagonal(self.beyond(x))

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the covariance of all torques of x with each other, (N n, N n), exactly symmetric.

        What the features leave is independent in each sample.
        """
        return super().symmetric_gram(params, x) + np.diag(self.beyond(x).reshape(-1))

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return no hyperparameters."""
        return {}

    def _moments(self, x: Motion) -> tuple[Array, Array]:
        mean, beyond = np.empty((2, *x.q.shape))
        self.fill_all(x.arrays(), np.empty((len(x), int(self.sizes.sum()), self.n_joints)), 0, mean, beyond)
        return mean, beyond


class _ResidualRegressor(Regressor):
    """Features of a residual."""

    def __init__(self, kernel: ResidualKernel) -> None:
        self.n_joints, self.size, self._kernel = kernel.n_joints, int(kernel.sizes.sum()), kernel

    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of one query; see `Regressor.fill`."""
        self.fill_many(motion[None], out[None], 0)

    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries; see `Regressor.fill_many`."""
        unused = np.empty((2, len(motions), self.n_joints))
        self._kernel.fill_all(motions, out, first, *unused)


def residual_inputs(motion: Motion) -> Array:
    """Return x = (q, dq, ddq, tanh(dq / SIGN_WIDTH)) of N instants, (N, 4 n), in the array API."""
    xp = array_namespace(motion.q)
    return xp.concat([motion.q, motion.dq, motion.ddq, xp.tanh(motion.dq / SIGN_WIDTH)], axis=1)
