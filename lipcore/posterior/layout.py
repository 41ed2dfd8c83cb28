"""Weights and root of a posterior, as compiled code reads them: factors of the linear terms' features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lipcore.data.motion import Array, Indices
from lipcore.kernels.base import LinearKernel, Params
from lipcore.kernels.fast.answer import pack, pack_joints


def prior_variances(linear: Sequence[LinearKernel], params: Params) -> Array:
    """Return the prior variances Λ of all linear weights, term after term, (P,)."""
    return np.concatenate([np.zeros(0), *(each.variances(params) for each in linear)])


def feature_factors(linear: Sequence[LinearKernel], params: Params, weights: Array, root: Array) -> tuple[Array, Array]:
    """Return weights (M,) and root Q (M, M) of the torques and of the features Φᵀ, given those of Λ Φᵀ.

    The torques come first. The weights include the prior means of the linear weights.
    """
    variances = prior_variances(linear, params)
    torques = len(weights) - len(variances)
    scale = np.concatenate([np.ones(torques), variances])
    slopes, first = weights * scale, torques
    for each in linear:
        last = first + len(each.variances(params))
        if (mean := each.prior_weights()) is not None:
            slopes[first:last] += mean
        first = last
    return slopes, root * scale


def weights_of_joints(linear: Sequence[LinearKernel]) -> list[Indices]:
    """Return the places among all linear weights of those that each joint's torque may depend on."""
    first = np.cumsum([0, *(each.regressor().size for each in linear)])
    of_term = list(zip(first, linear, strict=False))
    return [np.concatenate([at + each.of_joint(j) for at, each in of_term]) for j in range(linear[0].n_joints)]


def pack_factors(slopes: Array, root: Array, torques: int, parts: list[Indices]) -> Array:
    """Return the `fixed` array of `answer`. torques: m of the M factors; parts: weights of each joint, or none."""
    # rows of a panel have the same sign
    panels = [pack(root[:torques], 0), pack(root[torques:], torques)]
    return np.concatenate([pack(slopes[None], len(slopes)), *panels, pack_joints(slopes, root, parts)])


def check_factors(outputs: Indices, torques: int, weights: Array, root: Array, linear_weights: int) -> None:
    """Raise ValueError if shapes do not match, an output is not one of `torques`, or root is not lower triangular."""
    size = len(outputs) + linear_weights
    if outputs.ndim != 1 or np.any((outputs < 0) | (outputs >= torques)):
        raise ValueError(f"outputs are {outputs}, expected numbers from 0 to {torques - 1}")
    if size == 0:
        raise ValueError("there are no outputs and no linear weights, expected at least one of them")
    if weights.shape != (size,):
        raise ValueError(f"weights have shape {weights.shape}, expected ({size},)")
    if root.shape != (size, size):
        raise ValueError(f"root has shape {root.shape}, expected ({size}, {size})")
    if np.any(np.triu(root, 1)):
        raise ValueError("root has elements above the diagonal, expected a lower triangular matrix")
