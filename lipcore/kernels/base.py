"""What every torque kernel offers, and the one place where pairs of samples become a Gram matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace, device

from lipcore.data.motion import Array, Motion
from lipcore.extras import need

Params = Mapping[str, Array]
"""Unconstrained hyperparameters by name: logarithms of positive numbers, logits of shares."""

PAIRS_PER_CHUNK = 4096
"""Pairs of samples evaluated together: small enough for the processor's cache, large enough to hide call overhead."""


class Regressor(ABC):
    """Features Φ of tau = Φ w. Made by `LinearKernel.regressor`; safe from several threads; nothing is checked.

    n_joints: joints n. size: weights p.
    """

    n_joints: int
    size: int

    @abstractmethod
    def fill(self, motion: Array, out: Array) -> None:
        """Write Φᵀ of the query `motion`, (3, n) its q, dq and ddq, into `out`, (p, n), C-contiguous."""

    @abstractmethod
    def fill_many(self, motions: Array, out: Array, first: int) -> None:
        """`fill` for N queries, (N, 3, n), into the p rows of each of `out`, (N, …, n), from `first` on; the same
        numbers to the last bit."""


class Cross(ABC):
    """A kernel with its hyperparameters and S inducing samples fixed, ready to meet one query after the other.

    Made by `PairKernel.cross`. Safe from several threads: an implementation keeps memory for each (`threading.local`),
    computes without the GIL and allocates nothing in compiled code. Nothing is checked: arrays are float64 and
    C-contiguous, their shapes as stated.

    n_joints: joints n. size: inducing samples S.
    """

    n_joints: int
    size: int

    @abstractmethod
    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of the torques of N queries into `out`, (N, S + 1, n, n) (N·m)².

        motions: (N, 3, n), q, dq and ddq of each; not modified. out[k, s, i, j] becomes the covariance of torque i at
        inducing sample s with torque j at query k, s < S, and out[k, S] that of the query's torques with each other,
        symmetric. A query is answered the same to the last bit whatever others there are.
        """


@dataclass(frozen=True)
class State:
    """One argument of a kernel, joints first so that formulas read as in the paper.

    q, v, a: (n, *batch) position, velocity, acceleration; the batches of two arguments broadcast.
    """

    q: Array
    v: Array
    a: Array

    @classmethod
    def rows(cls, motion: Motion) -> State:
        """First argument of all pairs: (n, N, 1)."""
        return cls(motion.q.T[:, :, None], motion.dq.T[:, :, None], motion.ddq.T[:, :, None])

    @classmethod
    def columns(cls, motion: Motion) -> State:
        """Second argument of all pairs: (n, 1, M)."""
        return cls(motion.q.T[:, None, :], motion.dq.T[:, None, :], motion.ddq.T[:, None, :])

    @classmethod
    def paired(cls, motion: Motion) -> State:
        """Either argument when sample k meets sample k only: (n, N)."""
        return cls(motion.q.T, motion.dq.T, motion.ddq.T)

    def first(self, joints: int) -> State:
        """Only the first `joints` joints: the chain up to a link."""
        return State(self.q[:joints], self.v[:joints], self.a[:joints])


class TorqueKernel(ABC):
    """Prior of the joint torques of an n-joint robot: a covariance, and a mean that is zero unless said otherwise.

    Gram matrices have rows and columns sample by sample, n a sample.
    """

    n_joints: int

    @abstractmethod
    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Covariance of all torques of x (N samples) with all of y (M): (N n, M n), (N·m)²."""

    @abstractmethod
    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Covariance of all torques of x with each other, (N n, N n), exactly symmetric."""

    @abstractmethod
    def variance(self, params: Params, x: Motion) -> Array:
        """Prior covariance of the torques at each sample: (N, n, n)."""

    @abstractmethod
    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Derivative of Σ weight ∘ gram(x, x) by each of the kernel's hyperparameters; weight symmetric, (N n, N n)."""

    @abstractmethod
    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Hyperparameters to start a fit from, scaled to the data. motion: N samples, tau: (N, n)."""

    def names(self) -> list[str]:
        """Names of the kernel's hyperparameters."""
        return list(self.shapes())

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the kernel's hyperparameters by name."""
        one = np.ones((2, self.n_joints))
        return {name: value.shape for name, value in self.initial(Motion(one, one, one), one).items()}

    def prior_std(self) -> dict[str, float]:
        """Width of the Gaussian prior around the start, for hyperparameters whose width is not the usual one."""
        return {}

    def mean(self, x: Motion) -> Array:
        """Prior mean of the torques, (N, n) N·m."""
        return np.zeros_like(x.q)


class PairKernel(TorqueKernel):
    """A kernel given as a formula for one pair of samples.

    Formulas are written in the Python array API standard: NumPy computes them, and PyTorch, which is imported there
    alone, differentiates them, or computes them on a GPU. Then all arguments are its tensors.
    """

    @abstractmethod
    def blocks(self, params: Params, x: State, y: State) -> Array:
        """Covariance of torque i at x with torque j at y: (n, n, *batch), (N·m)²."""

    def cross(self, params: Params, inducing: Motion) -> Cross:
        """Covariance of one query with the inducing samples and itself, for serving."""
        return _FormulaCross(self, params, inducing)

    def variance(self, params: Params, x: Motion) -> Array:
        """Prior covariance of the torques at each sample: (N, n, n)."""
        state = State.paired(x)
        return array_namespace(x.q).permute_dims(self.blocks(params, state, state), (2, 0, 1))

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Covariance of all torques of x with all of y: (N n, M n)."""
        xp, n, columns = array_namespace(x.q), self.n_joints, State.columns(y)
        out = xp.empty((len(x), n, len(y), n), dtype=x.q.dtype, device=device(x.q))
        for rows in row_chunks(len(x), len(y)):
            block = self.blocks(params, State.rows(x[rows]), columns)
            out[rows] = xp.permute_dims(block, (2, 0, 3, 1))
        return out.reshape(len(x) * n, len(y) * n)

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Covariance of all torques of x with each other, (N n, N n): half the work of `gram`, exactly symmetric."""
        xp, n, size = array_namespace(x.q), self.n_joints, len(x)
        out = xp.empty((size, n, size, n), dtype=x.q.dtype, device=device(x.q))
        for rows in row_chunks(size, size):
            block = self.blocks(params, State.rows(x[rows]), State.columns(x[rows.start :]))
            out[rows, :, rows.start :] = xp.permute_dims(block, (2, 0, 3, 1))
            out[rows.start :, :, rows] = xp.permute_dims(block, (3, 1, 2, 0))
        gram = out.reshape(size * n, size * n)
        # pairs inside a diagonal block were computed both ways, equal only to rounding
        return 0.5 * (gram + gram.T)

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Derivative of Σ weight ∘ gram(x, x), by PyTorch's automatic differentiation."""
        need("torch", "train")
        from lipcore.kernels.differentiation import gradient  # noqa: PLC0415 - it imports torch

        return gradient(self, params, x, weight)


class _FormulaCross(Cross):
    """`Cross` of any pair kernel, by its `blocks`: a query takes a fraction of a millisecond."""

    def __init__(self, kernel: PairKernel, params: Params, inducing: Motion) -> None:
        self.size, self.n_joints = len(inducing), kernel.n_joints
        self._blocks, self._anchors = kernel.blocks, State.paired(inducing)
        self._params = {name: value.copy() for name, value in params.items()}

    def fill_many(self, motions: Array, out: Array) -> None:
        """Write the covariances of N queries; see `Cross.fill_many`."""
        anchors = (self._anchors.q, self._anchors.v, self._anchors.a)
        for query, block in zip(motions[..., None], out, strict=True):
            rows = State(*(np.concatenate(pair, axis=1) for pair in zip(anchors, query, strict=True)))
            block[:] = self._blocks(self._params, rows, State(*query)).transpose(2, 0, 1)
            block[-1] = 0.5 * (block[-1] + block[-1].T)


class LinearKernel(TorqueKernel):
    """A torque that is linear in unknown weights with a Gaussian prior: tau = Φ(q, dq, ddq) w.

    The weights are independent beforehand: their covariance Λ is diagonal.
    """

    @abstractmethod
    def regressor(self) -> Regressor:
        """Φ of one query, for serving."""

    def features(self, x: Motion) -> Array:
        """Φ at each sample: (N, n, p)."""
        regressor = self.regressor()
        rows = np.empty((len(x), regressor.size, self.n_joints))
        regressor.fill_many(x.arrays(), rows, 0)
        return np.ascontiguousarray(rows.transpose(0, 2, 1))

    @abstractmethod
    def variances(self, params: Params) -> Array:
        """Prior variances of the weights, the diagonal of Λ: (p,)."""

    def variances_adjoint(self, params: Params, slopes: Array) -> dict[str, Array]:
        """Derivatives by each hyperparameter, given those by the `variances`, (p,); none where there are none."""
        return {}

    def prior_weights(self) -> Array | None:
        """Prior mean of the weights, (p,); None for zero."""
        return None

    def mean(self, x: Motion) -> Array:
        """Prior mean of the torques, (N, n) N·m."""
        weights = self.prior_weights()
        return np.zeros_like(x.q) if weights is None else self.features(x) @ weights

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Φ(x) Λ Φ(y)ᵀ: (N n, M n)."""
        return (self.flat_features(x) * self.variances(params)) @ self.flat_features(y).T

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Φ(x) Λ Φ(x)ᵀ, exactly symmetric: (N n, N n)."""
        rows = self.flat_features(x)
        gram = (rows * self.variances(params)) @ rows.T
        return 0.5 * (gram + gram.T)

    def variance(self, params: Params, x: Motion) -> Array:
        """Prior covariance of the torques at each sample: (N, n, n)."""
        features = self.features(x)
        return (features * self.variances(params)) @ features.mT

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Derivative of Σ weight ∘ Φ Λ Φᵀ = Σ_k Λ_kk (Φᵀ weight Φ)_kk."""
        rows = self.flat_features(x)
        return self.variances_adjoint(params, np.einsum("ik,ik->k", rows, weight @ rows))

    def flat_features(self, x: Motion) -> Array:
        """Φ of all torques, sample by sample: (N n, p)."""
        features = self.features(x)
        return features.reshape(-1, features.shape[-1])


class SumKernel(TorqueKernel):
    """Sum of independent torque priors, e.g. rigid-body dynamics plus friction."""

    def __init__(self, *terms: TorqueKernel) -> None:
        sizes = {term.n_joints for term in terms}
        if len(sizes) != 1:
            raise ValueError(f"terms have {sorted(sizes)} joints, expected the same number in all")
        self.terms = terms
        self.n_joints = terms[0].n_joints

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Sum of the terms' Gram matrices."""
        return _total([term.gram(params, x, y) for term in self.terms])

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Sum of the terms' Gram matrices, exactly symmetric."""
        return _total([term.symmetric_gram(params, x) for term in self.terms])

    def variance(self, params: Params, x: Motion) -> Array:
        """Sum of the terms' prior covariances at each sample: (N, n, n)."""
        return _total([term.variance(params, x) for term in self.terms])

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Each term's derivatives: no hyperparameter belongs to two terms."""
        return {name: value for term in self.terms for name, value in term.gradient(params, x, weight).items()}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Union of the terms' hyperparameters."""
        return {name: value for term in self.terms for name, value in term.initial(motion, tau).items()}

    def prior_std(self) -> dict[str, float]:
        """Union of the terms' widths."""
        return {name: value for term in self.terms for name, value in term.prior_std().items()}

    def mean(self, x: Motion) -> Array:
        """Sum of the terms' prior means."""
        return _total([term.mean(x) for term in self.terms])


def row_chunks(n_rows: int, n_columns: int) -> Iterator[slice]:
    """Slices over `n_rows` such that rows × `n_columns` stays near PAIRS_PER_CHUNK."""
    step = max(1, PAIRS_PER_CHUNK // max(1, n_columns))
    for start in range(0, n_rows, step):
        yield slice(start, min(start + step, n_rows))


def _total(parts: list[Array]) -> Array:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def on_diagonal(values: Array) -> Array:
    """Blocks with these on the diagonal and zero elsewhere: (n, *batch) to (n, n, *batch)."""
    n = values.shape[0]
    unit = array_namespace(values).eye(n, dtype=values.dtype, device=device(values))
    return unit.reshape((n, n) + (1,) * (values.ndim - 1)) * values


def on_last_diagonal(values: Array) -> Array:
    """The same with joints last: (*batch, n) to (*batch, n, n)."""
    xp = array_namespace(values)
    return values[..., None] * xp.eye(values.shape[-1], dtype=values.dtype, device=device(values))
