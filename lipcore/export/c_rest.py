"""Tables for C of the terms beside rigid bodies: energies (`energy.c.in`), local correction (`residual.c.in`).

Torques of such a term have the covariances c with m torques of inducing samples. They add αᵀ c to the mean and k₁ − |Q₁
c|² to the variance. Q₂ c is added to the product of the weights' features and their deviations, see `CompactPosterior`.
The features of a correction take the place of c. The variance beyond them is added, see `JointResidual`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.base import Params
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.fast.answer import root_of_part
from lipcore.kernels.fast.joints import read_rows
from lipcore.kernels.residual import ResidualKernel
from lipcore.posterior.compact import CompactPosterior

LANES = 4
"""Samples of energies that are computed together."""


@dataclass(frozen=True)
class NonlinearTerm:
    """The contribution of a nonlinear term."""

    tables: dict[str, Array]
    """Tables of the template, by name."""
    groups: int
    """Number of groups of samples in these tables."""
    places: NDArray[np.int64]
    """Index of each torque of a sample among the m inducing torques, else −1, (S, n)."""
    alpha: Array
    """Weights α of the covariances in the mean, (m,)."""
    learnt: Array
    """Q₁, (m, m) lower triangular."""
    factor: float
    """Factor on deviations."""

    @classmethod
    def of(cls, posterior: CompactPosterior) -> NonlinearTerm | None:
        """Return the nonlinear term of a posterior; None if it has no inducing torques."""
        basis, term = posterior.basis, posterior.basis.term
        if term is None or not len(basis.outputs):
            return None
        n, count, outputs = term.n_joints, len(basis.outputs), basis.outputs
        used, number = np.unique(outputs // n, return_inverse=True)
        motion = basis.inducing[used]
        assert isinstance(term, ChainKernel)
        tables = _energy(term, posterior.params, motion)
        groups = len(tables["samples"])
        places = np.full((groups * LANES, n), -1)
        places[number, outputs % n] = np.arange(count)
        learnt = posterior.root[:count, :count]
        return cls(tables, groups, places, posterior.weights[:count], learnt, posterior.std_factor)


def correction_tables(residual: ResidualKernel, posterior: CompactPosterior) -> dict[str, Array | NDArray[np.int64]]:
    """Return the tables of a local correction."""
    joints, first, size = residual.joints, posterior.basis.rows(residual).start, len(posterior.weights)
    others = np.delete(np.arange(size), posterior.basis.rows(residual))
    weights, learnt = [], []
    for joint, each in enumerate(joints):
        own, mean = first + residual.of_joint(joint), each.weights.copy()
        mean[: len(own)] += posterior.weights[own] @ each.root
        weights.append(mean)
        # the rows of all other weights are in `LinearWeights.shared`
        root = root_of_part(posterior.root, np.concatenate([own, others]))[: len(own), : len(own)]
        learnt.append(posterior.std_factor * root[np.tril_indices(len(own))])
    return {
        "rates": np.stack([1 / each.lengthscales for each in joints]),
        "variance": residual.prior,
        "taken": np.array([each.taken for each in joints]),
        "starts": np.cumsum([0, *map(len, weights)]),
        "rows": np.cumsum([0, *residual.sizes]),
        "centres": np.concatenate([each.centres for each in joints]),
        "weights": np.concatenate(weights),
        "roots": np.concatenate([each.triangle for each in joints]),
        "learnt": np.concatenate(learnt),
    }


def _energy(term: ChainKernel, params: Params, motion: Motion) -> dict[str, Array]:
    """Return the tables of energies.

    They are: shares of each joint's kernel, and scales, (n,) each; weights, (n, n); samples, (G, 6, n, LANES), see
    `lipcore.kernels.fast.joints.read_rows`.
    """
    shares, scales, weights = term.hyper(params)
    slides = np.array([kind == "prismatic" for kind in term.joint_types])
    rows = read_rows(np.ascontiguousarray(motion.arrays()), slides)
    groups = -(-len(rows) // LANES)
    padded = np.zeros((groups * LANES, *rows.shape[1:]))
    padded[: len(rows)] = rows
    samples = padded.reshape(groups, LANES, *rows.shape[1:]).transpose(0, 2, 3, 1)
    shared = dict(zip(("constant", "cosine", "sine"), shares[0].T, strict=True))
    return {**shared, "scales": scales, "weights": np.tril(weights), "samples": samples}
