"""The compact posterior: a Gaussian over M basis functions, made of sums over samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.base import LinearKernel, Params, TorqueKernel, on_last_diagonal
from lipcore.posterior.basis import Basis
from lipcore.posterior.exact import Posterior, Prediction
from lipcore.posterior.linalg import solve_lower, solve_lower_right
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.statistics import Solution, Statistics, learnt_root, solve


@dataclass(frozen=True)
class CompactPosterior(Posterior):
    """Posterior whose anchors are the M variables of a basis (DESIGN §4).

    The whitened variables have the posterior N(ŵ, Σ), from statistics alone N((I + A)⁻¹ b, (I + A)⁻¹). With
    c = cov(u, f(x)) = B φ(x):

        mean       E f(x) + φᵀ ŵ                = E f(x) + cᵀ α,     α = B⁻ᵀ ŵ
        variance   k(x, x) − φᵀφ + φᵀ Σ φ       = k₁(x, x) − |Q₁ c|² + |Q₂ c|²,     Q = R B⁻¹

    where φ does not reach, the variance is the prior's. k₁ is the nonlinear term, to whose torques the rows Q₁ belong:
    of the linear ones, which may be far less certain beforehand than afterwards, nothing is subtracted (see
    `Solution`). root: Q, (M, M) lower triangular; noise_variance: (n,) R;
    floor: (n,) (N·m)², which the variance of a torque is never below, whatever the samples say; zero but for models
    that learn online (see `online.record.error_floor`). misfit: variance of the torque besides.
    statistics: what it was made from; None where that is more than one sum.
    """

    basis: Basis
    noise_variance: Array
    root: Array
    floor: Array
    misfit: Misfit
    statistics: Statistics | None = None

    @classmethod
    def build(
        cls,
        kernel: TorqueKernel,
        basis: Basis,
        statistics: Statistics,
        noise_variance: Array,
        std_factor: float = 1.0,
        misfit: Misfit | None = None,
    ) -> CompactPosterior:
        """Posterior of statistics (eq. 24 of docs/method.md).

        noise_variance: (n,) (N·m)²; std_factor: calibration; misfit: none where None. Raise NotPositiveDefiniteError
        for statistics that no samples have.
        """
        posterior = cls.solved(
            kernel, basis, solve(statistics, None, len(basis.outputs)), noise_variance, std_factor, None, misfit
        )
        return replace(posterior, statistics=statistics)

    @classmethod
    def restore(
        cls,
        kernel: TorqueKernel,
        params: Params,
        inducing: Motion,
        outputs: Indices,
        statistics: Statistics,
        jitter: float = 0.0,
        std_factor: float = 1.0,
        misfit: Misfit | None = None,
    ) -> CompactPosterior:
        """Rebuild a posterior from what a file holds: hyperparameters, inducing outputs (see `Basis`) and statistics.

        jitter: (N·m)², what the fit has added to the noise's variance.
        Raise ValueError naming what is missing, unknown or of the wrong shape.
        """
        expected = {**kernel.shapes(), "noise.log_std": (kernel.n_joints,)}
        for name in expected.keys() | params.keys():
            shape = params[name].shape if name in params else None
            if shape != expected.get(name):
                raise ValueError(f"hyperparameter {name!r} has shape {shape}, expected {expected.get(name)}")
        basis = Basis.build(kernel, params, inducing, outputs)
        size = len(basis)
        if statistics.a.shape != (size, size) or statistics.b.shape != (size,):
            raise ValueError(
                f"statistics have shapes {statistics.a.shape} and {statistics.b.shape}, "
                f"expected {(size, size)} and {(size,)}"
            )
        noise_variance = np.exp(2 * params["noise.log_std"]) + jitter
        return cls.build(kernel, basis, statistics, noise_variance, std_factor, misfit)

    @classmethod
    def solved(
        cls,
        kernel: TorqueKernel,
        basis: Basis,
        solution: Solution,
        noise_variance: Array,
        std_factor: float = 1.0,
        floor: Array | None = None,
        misfit: Misfit | None = None,
    ) -> CompactPosterior:
        """Posterior of the torques, given that of the whitened variables.

        solution: whose `first` are the nonlinear term's; noise_variance: (n,) (N·m)²; floor: (n,) (N·m)²; misfit; none
        where None.
        """
        assert solution.first == len(basis.outputs)
        weights = solve_lower(basis.root, solution.mean, transposed=True)
        # and not from QᵀQ itself: B⁻¹ is badly conditioned
        root = solve_lower_right(solution.root, basis.root)
        floor = np.zeros_like(noise_variance) if floor is None else floor
        misfit = Misfit.none(len(noise_variance)) if misfit is None else misfit
        return cls(kernel, basis.params, std_factor, weights, basis, noise_variance, root, floor, misfit)

    def row_variance(self, motion: Motion) -> Array:
        """Variance R with which each of N rows teaches, as far as the basis reaches: (N, n) (N·m)²."""
        return self.misfit.of_row(self.noise_variance, motion.dq)

    def predict(self, query: Motion, component: TorqueKernel | None = None) -> Prediction:
        """Posterior mean and n×n covariance of the torques at each of N queries, or of one term of the kernel.

        Floor and misfit are those of the whole torque: no term's share of them is known.
        """
        prediction = super().predict(query, component)
        if component is not None:
            return prediction
        variance = prediction.covariance.diagonal(axis1=1, axis2=2)
        more = np.maximum(self.misfit.variance(query), self.floor - variance)
        return Prediction(prediction.mean, prediction.covariance + on_last_diagonal(more))

    @cached_property
    def covariance(self) -> Array:
        """Σ of the whitened variables, (M, M)."""
        return Solution(self.weights, self.root @ self.basis.root, len(self.basis.outputs)).covariance

    @cached_property
    def learnt(self) -> Array:
        """What samples explain of any quantity: (M, M) lower triangular, whose square is B⁻ᵀ (I − Σ) B⁻¹."""
        return solve_lower_right(learnt_root(self.covariance), self.basis.root)

    def whiten(self, cross: Array) -> Array:
        """Columns whose square is explained, (M, K). cross: covariance of the variables with K quantities, (M, K)."""
        return self.learnt @ cross

    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Array]) -> Array:
        """Covariance of the variables with K quantities of the nonlinear term, zero for linear weights: (M, K).

        covariance: that of the term's torques at N motions with the quantities, (N n, K). Raise ValueError for another
        term.
        """
        if term is not self.basis.term:
            raise ValueError("the term is none of this posterior")
        inducing = covariance(self.basis.inducing)[self.basis.outputs]
        return np.concatenate([inducing, np.zeros((len(self.basis) - len(inducing), inducing.shape[1]))])

    def with_weights(self, term: LinearKernel, covariance: Array) -> Array:
        """Covariance of the variables with K quantities of a linear term, zero for all other variables: (M, K).

        covariance: cov(w, s), (p, K).
        """
        out = np.zeros((len(self.basis), covariance.shape[1]))
        out[self.basis.rows(term)] = covariance
        return out
