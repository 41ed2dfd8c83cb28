"""Basis functions of a compact posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.base import Cross, LinearKernel, PairKernel, Params, TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.kernels.residual import ResidualKernel
from lipcore.posterior.linalg import block_diagonal, cholesky, solve_lower


@dataclass(frozen=True)
class Basis:
    """m torques of the nonlinear term, chosen among those of S inducing samples, and all p weights of the linear terms.

    Together, these M = m + p variables u have the prior covariance B Bᵀ, and φ(x) = B⁻¹ cov(u, f(x)). In whitened form
    they are independent with variance one. The torque is φᵀ w plus a remainder of variance k(x, x) − φᵀφ.
    """

    term: PairKernel | None
    """Nonlinear term, or None if the estimator has none."""
    linear: tuple[LinearKernel, ...]
    """Linear terms."""
    params: Params
    inducing: Motion
    """S inducing samples."""
    outputs: Indices
    """Places of the chosen torques among the S n torques, sample by sample, (m,)."""
    root: Array
    """B, (M, M) lower triangular."""

    @classmethod
    def build(cls, kernel: TorqueKernel, params: Params, inducing: Motion, outputs: Indices) -> Basis:
        """Return the basis of a kernel's terms.

        params: hyperparameters; inducing: S samples; outputs: (m,), chosen torques, numbered as sample · n + joint.
        Raise ValueError if outputs and terms do not match.
        """
        term, linear = split(kernel)
        places = len(inducing) * kernel.n_joints
        if outputs.ndim != 1 or len(np.unique(outputs)) != len(outputs) or (term is None and len(outputs)):
            raise ValueError(f"outputs has shape {outputs.shape}, expected (m,) distinct places of torques")
        if len(outputs) and not (int(outputs.min()) >= 0 and int(outputs.max()) < places):
            raise ValueError(f"outputs reaches from {outputs.min()} to {outputs.max()}, expected 0 to {places - 1}")
        roots = [np.diag(np.sqrt(each.variances(params))) for each in linear]
        if term is not None:
            gram = term.symmetric_gram(params, inducing)
            roots.insert(0, cholesky(gram[np.ix_(outputs, outputs)]).lower)
        # files store no deflections, on which only linear terms depend
        return cls(term, linear, params, replace(inducing, deflections=None), outputs, block_diagonal(roots))

    def __len__(self) -> int:
        return len(self.root)

    def rows(self, linear: LinearKernel) -> slice:
        """Return the places of a linear term's weights among the variables."""
        start = len(self.outputs)
        for each in self.linear:
            size = len(each.variances(self.params))
            if each is linear.whole:
                return slice(start, start + size)
            start += size
        raise ValueError("the linear term does not belong to this basis")

    def features(self, query: Motion) -> Array:
        """Return φ(x) = B⁻¹ cov(u, f(x)) for the torques of N queries, (M, N n) (eq. 24 of docs/method.md)."""
        gram = None if self.term is None else self.term.gram(self.params, self.inducing, query)[self.outputs]
        return self._whitened(gram, query)

    def uncovered(self, query: Motion, features: Array) -> Array:
        """Return the variance k(x, x) − φᵀφ outside the basis at N queries, (N, n). features: φ(x), (M, N n)."""
        return self._open(self.prior(query), features)

    def prior(self, query: Motion) -> Array:
        """Return the prior variance at N queries, (N, n), of the nonlinear term and beyond a residual's features."""
        total = np.zeros_like(query.q) if self.residual is None else self.residual.beyond(query)
        if self.term is not None:
            total += self.term.variance(self.params, query).diagonal(axis1=1, axis2=2)
        return total

    def features_and_uncovered(self, query: Motion) -> tuple[Array, Array]:
        """Return `features` (M, N n) and `uncovered` (N, n) of N queries.

        This is compiled code for the CPU, fast for few queries at a time.
        """
        if self._cross is None:
            features = self.features(query)
            return features, self.uncovered(query, features)
        n, size = query.n_joints, self._cross.size
        blocks = np.empty((len(query), size + 1, n, n))
        self._cross.fill_many(query.arrays(), blocks)
        gram = blocks[:, :size].transpose(1, 2, 0, 3).reshape(size * n, len(query) * n)[self.outputs]
        features = self._whitened(gram, query)
        return features, self._open(blocks[:, size].diagonal(axis1=1, axis2=2), features)

    @cached_property
    def residual(self) -> ResidualKernel | None:
        """The linear term that has a variance beyond its features, or None."""
        return next((each for each in self.linear if isinstance(each, ResidualKernel)), None)

    @cached_property
    def _cross(self) -> Cross | None:
        return None if self.term is None else self.term.cross(self.params, self.inducing)

    def _whitened(self, gram: Array | None, query: Motion) -> Array:
        """Return φ of N queries, (M, N n). gram: covariance of the chosen torques with theirs, (m, N n)."""
        out = np.empty((len(self), len(query) * query.n_joints))
        first = len(self.outputs)
        if gram is not None:
            out[:first] = solve_lower(self.root[:first, :first], gram)
        for each in self.linear:
            rows = each.flat_features(query).T
            last = first + len(rows)
            np.multiply(rows, self.scales[first:last, None], out=out[first:last])
            first = last
        return out

    @cached_property
    def scales(self) -> Array:
        """Factors B⁻¹ Λ of the linear weights' features, (M,), both diagonal there; 0 for the torques."""
        scales = np.zeros(len(self))
        for each in self.linear:
            rows = self.rows(each)
            scales[rows] = each.variances(self.params) / self.root.diagonal()[rows]
        return scales

    def _open(self, prior: Array, features: Array) -> Array:
        # the linear terms' own features explain all of their variance
        chosen = features[: len(self.outputs)]
        explained = np.einsum("mk,mk->k", chosen, chosen).reshape(prior.shape)
        return np.asarray(np.maximum(prior - explained, 0.0))


def split(kernel: TorqueKernel) -> tuple[PairKernel | None, tuple[LinearKernel, ...]]:
    """Return the nonlinear term of a kernel, or None, and its linear terms. Raise ValueError for any other kernel."""
    terms: Sequence[TorqueKernel] = kernel.terms if isinstance(kernel, SumKernel) else (kernel,)
    nonlinear = [each for each in terms if isinstance(each, PairKernel)]
    linear = tuple(each for each in terms if isinstance(each, LinearKernel))
    if len(nonlinear) > 1 or len(nonlinear) + len(linear) < len(terms):
        names = ", ".join(type(each).__name__ for each in terms)
        raise ValueError(f"the kernel's terms are {names}, expected at most one pair kernel beside linear ones")
    return (nonlinear[0] if nonlinear else None), linear
