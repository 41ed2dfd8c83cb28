"""What an evaluator needs of a posterior, checked once and laid out for `compiled.answer`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lipcore.kernels.base import LinearKernel, Params
from lipcore.kernels.compiled.panels import pack

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def linear_prior(linear: Sequence[LinearKernel], params: Params) -> tuple[Array, Array]:
    """Prior means and variances of all linear weights, term after term, (P,) each.

    Raises ValueError for weights that are correlated beforehand, which no kernel's are.
    """
    means, variances = [np.zeros(0)], [np.zeros(0)]
    for term in linear:
        covariance = term.covariance(params).detach().cpu().numpy()
        variance = np.diagonal(covariance).copy()
        if np.any(covariance != np.diag(variance)):
            raise ValueError(f"{type(term).__name__}: prior covariance of the weights, expected a diagonal matrix")
        mean = term.prior_weights()
        means.append(np.zeros(len(variance)) if mean is None else mean.detach().cpu().numpy())
        variances.append(variance)
    return np.concatenate(means), np.concatenate(variances)


def check(outputs: Indices, torques: int, weights: Array, root: Array, linear_weights: int) -> None:
    """Raise ValueError where shapes do not fit, an output is none of `torques`, or root is not lower triangular."""
    size = len(outputs) + linear_weights
    if outputs.ndim != 1 or np.any((outputs < 0) | (outputs >= torques)):
        raise ValueError(f"outputs are {outputs}, expected numbers from 0 to {torques - 1}")
    if size == 0:
        raise ValueError("neither outputs nor linear weights: expected at least one of them")
    if weights.shape != (size,):
        raise ValueError(f"weights have shape {weights.shape}, expected ({size},)")
    if root.shape != (size, size):
        raise ValueError(f"root has shape {root.shape}, expected ({size}, {size})")
    if np.any(np.triu(root, 1)):
        raise ValueError("root has elements above the diagonal, expected a lower triangular matrix")


def lay_out(weights: Array, root: Array, means: Array, variances: Array) -> Array:
    """The `fixed` array of `compiled.answer`, for features Φᵀ in the place of their covariances Λ Φᵀ."""
    scale = np.ones(len(weights))
    scale[len(scale) - len(variances) :] = variances
    slopes = weights * scale
    slopes[len(scale) - len(means) :] += means
    return np.concatenate([variances, pack(slopes[None], triangular=False), pack(root * scale, triangular=True)])
