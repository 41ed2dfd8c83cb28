"""Interfaces of all torque kernels, and the construction of Gram matrices from pairs of samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace, device
from numpy.typing import NDArray

from lipcore.data.motion import Array, Indices, Motion
from lipcore.extras import import_extra
from lipcore.kernels.arrays import constant, reordered

Params = Mapping[str, Array]
"""Unconstrained hyperparameters by name. Positive numbers are stored as logarithms, shares as logits."""

PAIRS_PER_CHUNK = 4096
"""Pairs of samples evaluated together. They fit the processor's cache, and they are enough to hide the call
overhead."""


class Regressor(ABC):
    """Features Φ of a linear torque, tau = Φ w.

    `LinearKernel.regressor` creates it. It is thread-safe. It does not check its arguments.
    """

    n_joints: int
    """Number of joints n."""
    size: int
    """Number of weights p."""

    @abstractmethod
    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of one query into `out`, (p, n), C-contiguous. motion: (3, n), the query's q, dq and ddq."""

    @abstractmethod
    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """Write Φᵀ of N queries, (N, 3, n), into the p rows of each part of `out`, (N, …, n), from row `first` on.

        The numbers are those of `fill`, to the last bit.
        """

    def features(self, motions: Array) -> Array:
        """Return Φ of N queries, (N, n, p). motions: as of `Motion.arrays`."""
        rows = np.empty((len(motions), self.size, self.n_joints))
        self.fill_many(motions, rows, 0)
        return np.ascontiguousarray(rows.transpose(0, 2, 1))


class Cross(ABC):
    """Covariances of single queries with S inducing samples, for a kernel with fixed hyperparameters.

    `PairKernel.cross` creates it. It is thread-safe: an implementation keeps memory for each thread
    (`threading.local`). Compiled code runs without the GIL and allocates nothing. Arguments are not checked: arrays are
    float64 and C-contiguous, with the stated shapes.
    """

    n_joints: int
    """Number of joints n."""
    size: int
    """Number of inducing samples S."""

    @abstractmethod
    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of the torques of N queries into `out`, (N, S + 1, n, n) (N·m)².

        motions: (N, 3, n), q, dq and ddq of each query; not modified. For s < S, out[k, s, i, j] is the covariance of
        torque i at inducing sample s with torque j at query k. out[k, S] is the covariance of the query's torques with
        each other, symmetric. The result for a query does not depend on the other queries, to the last bit.
        """


@dataclass(frozen=True)
class State:
    """One argument of a kernel. Joints come first, so that formulas read as in the paper.

    The batches of two arguments broadcast.
    """

    q: Array
    """Position, (n, *batch)."""
    v: Array
    """Velocity, (n, *batch)."""
    a: Array
    """Acceleration, (n, *batch)."""

    @classmethod
    def rows(cls, motion: Motion) -> State:
        """Return the first argument of all pairs, (n, N, 1)."""
        return cls(motion.q.T[:, :, None], motion.dq.T[:, :, None], motion.ddq.T[:, :, None])

    @classmethod
    def columns(cls, motion: Motion) -> State:
        """Return the second argument of all pairs, (n, 1, M)."""
        return cls(motion.q.T[:, None, :], motion.dq.T[:, None, :], motion.ddq.T[:, None, :])

    @classmethod
    def paired(cls, motion: Motion) -> State:
        """Return either argument if sample k is paired with sample k alone, (n, N)."""
        return cls(motion.q.T, motion.dq.T, motion.ddq.T)

    def ordered(self, joints: Indices) -> State:
        """Return the joints in another order. joints: (n,), their places in this one."""
        return State(*(reordered(each, joints) for each in (self.q, self.v, self.a)))

    def first(self, joints: int) -> State:
        """Return the first `joints` joints: the chain up to a link."""
        return self.part(slice(joints))

    def part(self, joints: slice) -> State:
        """Return some of the joints."""
        return State(self.q[joints], self.v[joints], self.a[joints])


class TorqueKernel(ABC):
    """Gaussian prior of the joint torques of a robot with n joints: a covariance, and a mean that is zero by default.

    Rows and columns of a Gram matrix are ordered sample by sample, with n torques in each sample.
    """

    n_joints: int

    @abstractmethod
    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return the covariance of all torques of x (N samples) with those of y (M samples), (N n, M n) (N·m)²."""

    @abstractmethod
    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the covariance of all torques of x with each other, (N n, N n), exactly symmetric."""

    @abstractmethod
    def variance(self, params: Params, x: Motion) -> Array:
        """Return the prior covariance of the torques at each sample, (N, n, n)."""

    @abstractmethod
    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return the derivative of Σ weight ∘ gram(x, x) by each hyperparameter. weight: symmetric, (N n, N n)."""

    @abstractmethod
    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return the hyperparameters that a fit starts from, scaled to the data. motion: N samples; tau: (N, n)."""

    def names(self) -> list[str]:
        """Return the names of the hyperparameters."""
        return list(self.shapes())

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the hyperparameters by name."""
        one = np.ones((2, self.n_joints))
        return {name: value.shape for name, value in self.initial(Motion(one, one, one), one).items()}

    def prior_std(self) -> dict[str, float]:
        """Return the prior standard deviations around the start, for hyperparameters that do not use the default."""
        return {}

    def mean(self, x: Motion) -> Array:
        """Return the prior mean of the torques, (N, n) N·m."""
        return np.zeros_like(x.q)


class PairKernel(TorqueKernel):
    """Kernel given by a formula for one pair of samples.

    Formulas use the Python array API standard. NumPy computes them. PyTorch differentiates them, or computes them on a
    GPU; all arguments are then PyTorch tensors.
    """

    @abstractmethod
    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Return the covariance of torque i at x with torque j at y, (n, n, *batch) (N·m)²."""

    def cross(self, params: Params, inducing: Motion) -> Cross:
        """Return the covariances of single queries with the inducing samples and with themselves."""
        return _FormulaCross(self, params, inducing)

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the prior covariance of the torques at each sample, (N, n, n)."""
        state = State.paired(x)
        return array_namespace(x.q).permute_dims(self.blocks(params, state, state), (2, 0, 1))

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return the covariance of all torques of x with all torques of y, (N n, M n)."""
        xp, n, columns = array_namespace(x.q), self.n_joints, State.columns(y)
        out = xp.empty((len(x), n, len(y), n), dtype=x.q.dtype, device=device(x.q))
        for rows in row_chunks(len(x), len(y)):
            block = self.blocks(params, State.rows(x[rows]), columns)
            out[rows] = xp.permute_dims(block, (2, 0, 3, 1))
        return out.reshape(len(x) * n, len(y) * n)

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the covariance of all torques of x with each other, (N n, N n), exactly symmetric.

        It costs half the work of `gram`.
        """
        xp, n, size = array_namespace(x.q), self.n_joints, len(x)
        out = xp.empty((size, n, size, n), dtype=x.q.dtype, device=device(x.q))
        for rows in row_chunks(size, size):
            block = self.blocks(params, State.rows(x[rows]), State.columns(x[rows.start :]))
            out[rows, :, rows.start :] = xp.permute_dims(block, (2, 0, 3, 1))
            out[rows.start :, :, rows] = xp.permute_dims(block, (3, 1, 2, 0))
        gram = out.reshape(size * n, size * n)
        # pairs inside a diagonal block are computed in both orders and agree only to rounding
        return 0.5 * (gram + gram.T)

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return the derivative of Σ weight ∘ gram(x, x), computed by PyTorch's automatic differentiation."""
        import_extra("torch", "train")
        from lipcore.kernels.differentiation import gradient  # noqa: PLC0415 - it imports torch

        return gradient(self, params, x, weight)


class _FormulaCross(Cross):
    """`Cross` of any pair kernel, computed by its `blocks` in a fraction of a millisecond per query."""

    def __init__(self, kernel: PairKernel, params: Params, inducing: Motion) -> None:
        self.size, self.n_joints = len(inducing), kernel.n_joints
        self._blocks, self._anchors = kernel.blocks, State.paired(inducing)
        self._params = {name: value.copy() for name, value in params.items()}

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries; see `Cross.fill_many`."""
        anchors = (self._anchors.q, self._anchors.v, self._anchors.a)
        for query, block in zip(motions[:, :3, :, None], out, strict=True):
            rows = State(*(np.concatenate(pair, axis=1) for pair in zip(anchors, query, strict=True)))
            block[:] = self._blocks(self._params, rows, State(*query)).transpose(2, 0, 1)
            block[-1] = 0.5 * (block[-1] + block[-1].T)


class LinearKernel(TorqueKernel):
    """Torque that is linear in unknown weights with a Gaussian prior: tau = Φ(q, dq, ddq) w.

    The weights are independent a priori: their covariance Λ is diagonal.
    """

    @property
    def whole(self) -> LinearKernel:
        """The kernel that has these weights: itself, unless it is a `PartialKernel`."""
        return self

    @abstractmethod
    def regressor(self) -> Regressor:
        """Return the regressor that computes Φ for single queries."""

    @abstractmethod
    def formula(self, x: Motion) -> Array:
        """Return Φᵀ of N queries, (p, n, N), in the array API: what `features` computes, compiled.

        The arrays of x are of any library.
        """

    def weighted(self, weights: Array, x: Motion) -> Array:
        """Return Φ w of N queries, (n, N), in the array API. weights: w, (p,)."""
        rows = self.formula(x)
        return array_namespace(rows).tensordot(constant(weights, rows), rows, axes=1)

    def features(self, x: Motion) -> Array:
        """Return Φ at each sample, (N, n, p)."""
        return self.regressor().features(x.arrays())

    def of_joint(self, joint: int) -> NDArray[np.int64]:
        """Return the places of the weights that a joint's torque may depend on, rising: all by default."""
        return np.arange(self.regressor().size)

    @abstractmethod
    def variances(self, params: Params) -> Array:
        """Return the prior variances of the weights, the diagonal of Λ, (p,)."""

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Return the derivatives by the hyperparameters, given the derivatives by the `variances`, (p,)."""
        return {}

    def prior_weights(self) -> Array | None:
        """Return the prior mean of the weights, (p,), or None if it is zero."""
        return None

    def mean(self, x: Motion) -> Array:
        """Return the prior mean of the torques, (N, n) N·m."""
        weights = self.prior_weights()
        return np.zeros_like(x.q) if weights is None else self.features(x) @ weights

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return Φ(x) Λ Φ(y)ᵀ, (N n, M n)."""
        return (self.flat_features(x) * self.variances(params)) @ self.flat_features(y).T

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return Φ(x) Λ Φ(x)ᵀ, (N n, N n), exactly symmetric."""
        rows = self.flat_features(x)
        gram = (rows * self.variances(params)) @ rows.T
        return 0.5 * (gram + gram.T)

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the prior covariance of the torques at each sample, (N, n, n)."""
        features = self.features(x)
        return (features * self.variances(params)) @ features.mT

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return the derivative of Σ weight ∘ Φ Λ Φᵀ = Σ_k Λ_kk (Φᵀ weight Φ)_kk."""
        rows = self.flat_features(x)
        return self.variances_adjoint(params, np.einsum("ik,ik->k", rows, weight @ rows))

    def flat_features(self, x: Motion) -> Array:
        """Return Φ of all torques, sample by sample, (N n, p)."""
        features = self.features(x)
        return features.reshape(len(x) * self.n_joints, features.shape[-1])


def row_chunks(n_rows: int, n_columns: int) -> Iterator[slice]:
    """Yield slices over `n_rows` such that rows × `n_columns` stays near PAIRS_PER_CHUNK."""
    step = max(1, PAIRS_PER_CHUNK // max(1, n_columns))
    for start in range(0, n_rows, step):
        yield slice(start, min(start + step, n_rows))
