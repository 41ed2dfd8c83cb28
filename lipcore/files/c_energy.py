"""What a chain of energies adds to a model of rigid bodies, as C needs it: see `lipcore/files/c/energy.c.in`.

Torques of such a term have the covariances c with m torques of inducing samples. They add αᵀ c to the mean and
k₁ − |Q₁ c|² to the variance, and Q₂ c to what the weights' features make of their deviations, see `CompactPosterior`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.compiled.joints import read_rows
from lipcore.posterior.compact import CompactPosterior

LANES = 4
"""Samples that are computed together."""


@dataclass(frozen=True)
class Energy:
    """A chain's energies. shares: (n, 3) of each joint's kernel; scales: (n,); weights: (n, n); samples: (G, 6, n,
    LANES), of `joints.read`; places: (G LANES, n), of each torque among the m that count, else −1; alpha: (m,); learnt:
    Q₁, (m, m) lower triangular; factor: on deviations."""

    shares: Array
    scales: Array
    weights: Array
    samples: Array
    places: NDArray[np.int64]
    alpha: Array
    learnt: Array
    factor: float

    @classmethod
    def of(cls, posterior: CompactPosterior) -> Energy | None:
        """Those of a posterior; None where it has no nonlinear term."""
        basis, term = posterior.basis, posterior.basis.term
        if term is None:
            return None
        assert isinstance(term, ChainKernel)
        n, count, outputs = term.n_joints, len(basis.outputs), basis.outputs
        shares, scales, weights = term.hyper(posterior.params)
        used, number = np.unique(outputs // n, return_inverse=True)
        slides = np.array([kind == "prismatic" for kind in term.joint_types])
        rows = read_rows(np.ascontiguousarray(basis.inducing.arrays()[used]), slides)
        groups = -(-len(used) // LANES)
        padded = np.zeros((groups * LANES, *rows.shape[1:]))
        padded[: len(used)] = rows
        places = np.full((groups * LANES, n), -1)
        places[number, outputs % n] = np.arange(count)
        return cls(
            shares[0],
            scales,
            weights,
            padded.reshape(groups, LANES, *rows.shape[1:]).transpose(0, 2, 3, 1),
            places,
            posterior.weights[:count],
            posterior.root[:count, :count],
            posterior.std_factor,
        )
