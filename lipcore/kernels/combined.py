"""Kernels made of others: a sum of terms, and a part of a linear kernel's weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arrays import constant
from lipcore.kernels.base import LinearKernel, Params, Regressor, TorqueKernel


class PartialKernel(LinearKernel):
    """The torque of some of a linear kernel's weights. mask: of these weights, (p,)."""

    def __init__(self, whole: LinearKernel, mask: NDArray[np.bool_]) -> None:
        self.n_joints, self._whole, self._mask = whole.n_joints, whole, mask

    @property
    def whole(self) -> LinearKernel:
        """The kernel that has these weights."""
        return self._whole

    def regressor(self) -> Regressor:
        """Return the regressor of all weights."""
        return self._whole.regressor()

    def formula(self, x: Motion) -> Array:
        """Return Φᵀ, (p, n, N), zero for the other weights."""
        rows = self._whole.formula(x)
        kept: Array = constant(self._mask.astype(np.float64)[:, None, None], rows)
        return rows * kept

    def features(self, x: Motion) -> Array:
        """Return Φ at each sample, (N, n, p), zero for the other weights."""
        return self._whole.features(x) * self._mask

    def variances(self, params: Params) -> Array:
        """Return the prior variances of all weights, (p,)."""
        return self._whole.variances(params)

    def prior_weights(self) -> Array | None:
        """Return the prior mean of all weights, (p,)."""
        return self._whole.prior_weights()

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return the initial hyperparameters of all weights."""
        return self._whole.initial(motion, tau)


class SumKernel(TorqueKernel):
    """Sum of independent torque priors, for example rigid-body dynamics plus friction."""

    def __init__(self, *terms: TorqueKernel) -> None:
        sizes = {term.n_joints for term in terms}
        if len(sizes) != 1:
            raise ValueError(f"terms have {sorted(sizes)} joints, expected the same number in all")
        self.terms = terms
        self.n_joints = terms[0].n_joints

    def gram(self, params: Params, x: Motion, y: Motion) -> Array:
        """Return the sum of the terms' Gram matrices."""
        return _total([term.gram(params, x, y) for term in self.terms])

    def symmetric_gram(self, params: Params, x: Motion) -> Array:
        """Return the sum of the terms' Gram matrices, exactly symmetric."""
        return _total([term.symmetric_gram(params, x) for term in self.terms])

    def variance(self, params: Params, x: Motion) -> Array:
        """Return the sum of the terms' prior covariances at each sample, (N, n, n)."""
        return _total([term.variance(params, x) for term in self.terms])

    def gradient(self, params: Params, x: Motion, weight: Array) -> dict[str, Array]:
        """Return the derivatives of all terms. No two terms share a hyperparameter."""
        return {name: value for term in self.terms for name, value in term.gradient(params, x, weight).items()}

    def initial(self, motion: Motion, tau: Array) -> dict[str, Array]:
        """Return the hyperparameters of all terms."""
        return {name: value for term in self.terms for name, value in term.initial(motion, tau).items()}

    def prior_std(self) -> dict[str, float]:
        """Return the prior standard deviations of all terms."""
        return {name: value for term in self.terms for name, value in term.prior_std().items()}

    def mean(self, x: Motion) -> Array:
        """Return the sum of the terms' prior means."""
        return _total([term.mean(x) for term in self.terms])


def _total(parts: list[Array]) -> Array:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total
