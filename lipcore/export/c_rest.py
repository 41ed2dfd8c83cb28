"""The nonlinear term of a model as tables for C: `lipcore/export/c/energy.c.in` and `local.c.in`.

Torques of such a term have the covariances c with m torques of inducing samples. They add αᵀ c to the mean and k₁ − |Q₁
c|² to the variance. Q₂ c is added to the product of the weights' features and their deviations, see `CompactPosterior`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.motion import Motion
from lipcore.data.samples import Array
from lipcore.kernels.base import Params
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.fast.joints import read_rows
from lipcore.kernels.local import LocalKernel, scaled
from lipcore.posterior.compact import CompactPosterior

LANES = 4
"""Samples of energies that are computed together."""


@dataclass(frozen=True)
class NonlinearTerm:
    """The contribution of a nonlinear term."""

    template: str
    """Template of its covariances."""
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
        if isinstance(term, ChainKernel):
            template, tables = "energy.c", _energy(term, posterior.params, motion)
        else:
            assert isinstance(term, LocalKernel)
            template, tables = "local.c", _local(posterior.params, motion)
        groups = len(tables["samples"])
        places = np.full((groups * LANES if template == "energy.c" else groups, n), -1)
        places[number, outputs % n] = np.arange(count)
        learnt = posterior.root[:count, :count]
        return cls(template, tables, groups, places, posterior.weights[:count], learnt, posterior.std_factor)


def _energy(term: ChainKernel, params: Params, motion: Motion) -> dict[str, Array]:
    """Return the tables of energies.

    Shares of each joint's kernel, scales: (n,); weights: (n, n); samples: (G, 6, n, LANES), of
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


def _local(params: Params, motion: Motion) -> dict[str, Array]:
    """Return the tables of a local term.

    rate: (4 n,), one over the lengthscales; scales: (n,), variances; samples: (S, 4 n), in units of the lengthscales.
    """
    rate, scales = np.exp(-params["local.log_lengthscales"]), np.exp(params["local.log_scale"])
    return {"rate": rate, "scales": scales, "samples": scaled(params, motion)}
