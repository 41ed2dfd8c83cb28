"""The compact posterior: a Gaussian over M basis functions, computed from sums over samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from lipcore.data.motion import Array, Indices, Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.arrays import on_last_diagonal
from lipcore.kernels.base import LinearKernel, Params, TorqueKernel
from lipcore.posterior.basis import Basis
from lipcore.posterior.exact import Posterior, Prediction
from lipcore.posterior.layout import feature_factors
from lipcore.posterior.linalg import block_diagonal, solve_lower, solve_lower_right
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.statistics import Solution, Statistics, learnt_root, rounding_of, solve


@dataclass(frozen=True)
class CompactPosterior(Posterior):
    """Posterior with the M variables of a basis as anchors (DESIGN §4).

    The whitened variables have the posterior N(ŵ, Σ), from statistics alone N((I + A)⁻¹ b, (I + A)⁻¹). With c = cov(u,
    f(x)) = B φ(x):

        mean       E f(x) + φᵀ ŵ                = E f(x) + cᵀ α,     α = B⁻ᵀ ŵ
        variance   k(x, x) − φᵀφ + φᵀ Σ φ       = k₁(x, x) − |Q₁ c|² + |Q₂ c|²,     Q = R B⁻¹

    Outside the reach of φ, the variance is that of the prior. k₁ is the nonlinear term, to whose torques the rows Q₁
    belong. For the linear terms nothing is subtracted, because they may be far less certain a priori than a posteriori
    (see `Solution`).
    """

    basis: Basis
    """Basis of M variables."""
    noise_variance: Array
    """R, (n,) (N·m)²."""
    root: Array
    """Q, (M, M) lower triangular."""
    floor: Array
    """Min variance of each torque for any samples, (n,) (N·m)². Zero unless the model learns online, see
    `online.record.error_floor`."""
    misfit: Misfit
    """Additional variance of the torque."""
    statistics: Statistics | None = None
    """Statistics that the posterior was computed from, or None if they are more than one sum."""

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the fields: caches are computed again if they are needed."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

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
        """Return the posterior of statistics (eq. 24 of docs/method.md).

        noise_variance: (n,) (N·m)²; std_factor: calibration; misfit: None for no misfit. Raise NotPositiveDefiniteError
        for statistics that no samples can have.
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
        """Return the posterior of a file's content: hyperparameters, inducing outputs (see `Basis`) and statistics.

        jitter: (N·m)², added to the noise variance by the fit. Raise ValueError with the name of a value that is
        missing, unknown or of the wrong shape.
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
        """Return the posterior of the torques, given the posterior of the whitened variables.

        solution: its `first` leading variables belong to the nonlinear term; noise_variance: (n,) (N·m)²;
        floor: (n,) (N·m)²; misfit: None for no misfit.
        """
        assert solution.first == len(basis.outputs)
        weights = solve_lower(basis.root, solution.mean, transposed=True)
        # computed from Q and not from QᵀQ, because B⁻¹ is badly conditioned
        root = solve_lower_right(solution.root, basis.root)
        floor = np.zeros_like(noise_variance) if floor is None else floor
        misfit = Misfit.none(len(noise_variance)) if misfit is None else misfit
        for term in basis.linear:
            if isinstance(term, ArmKernel):
                misfit = replace(misfit, arms=term.arm.arm_of_joints)
        return cls(kernel, basis.params, std_factor, weights, basis, noise_variance, root, floor, misfit)

    def corrected(self, kernel: TorqueKernel, noise_variance: Array, a: Array) -> CompactPosterior:
        """Return this posterior beside a residual, whose weights have a mean of zero.

        kernel: with the residual before all other terms; noise_variance: beside it, (n,) (N·m)²; a: A of its samples,
        (p, p). The misfit stays, for motion far from samples. Raise ValueError if this posterior is more than one sum.
        """
        if self.statistics is None:
            raise ValueError("the posterior has no statistics, expected one as trained")
        params = {**self.params, "noise.log_std": 0.5 * np.log(noise_variance)}
        noise_variance = np.exp(2 * params["noise.log_std"])  # to the last bit as a file will be read
        basis = Basis.build(kernel, params, self.basis.inducing, self.basis.outputs)
        sums = Statistics(
            block_diagonal([a, self.statistics.a]),
            np.concatenate([np.zeros(len(a)), self.statistics.b]),
            self.statistics.samples,
        )
        return self.build(kernel, basis, sums, noise_variance, self.std_factor, self.misfit)

    def row_variance(self, motion: Motion) -> Array:
        """Return the variance R of each of N rows when it is learnt, (N, n) (N·m)², within the reach of the basis."""
        return self.row_misfit.of_row(self.noise_variance, motion)

    @property
    def row_misfit(self) -> Misfit:
        """The misfit of rows that are learnt: lasting errors that a residual has learnt are not part of their noise."""
        residual = self.basis.residual
        if residual is None:
            return self.misfit
        left = np.maximum(self.misfit.lasting - residual.prior, 0.0)
        return replace(self.misfit, lasting=np.minimum(left, self.noise_variance))

    def predict(self, query: Motion, component: TorqueKernel | None = None) -> Prediction:
        """Return the posterior mean and n×n covariance of the torques at each of N queries, or of one kernel term.

        Floor and misfit belong to the whole torque. Their share in one term is unknown, so it is not added there.
        """
        prediction = super().predict(query, component)
        if component is not None:
            return prediction
        variance = prediction.covariance.diagonal(axis1=1, axis2=2)
        more = np.maximum(self.misfit.variance(query), self.floor - variance)
        return Prediction(prediction.mean, prediction.covariance + on_last_diagonal(more))

    @property
    def slopes(self) -> Array:
        """Factors in the mean, (M,), of the torques' covariances and of the linear terms' features Φᵀ."""
        return self._feature_factors[0]

    @property
    def feature_root(self) -> Array:
        """Q for the linear terms' features Φᵀ instead of their covariances Λ Φᵀ, (M, M)."""
        return self._feature_factors[1]

    @cached_property
    def _feature_factors(self) -> tuple[Array, Array]:
        return feature_factors(self.basis.linear, self.params, self.weights, self.root)

    @cached_property
    def covariance(self) -> Array:
        """Σ of the whitened variables, (M, M)."""
        return Solution(self.weights, self.root @ self.basis.root, len(self.basis.outputs)).covariance

    @cached_property
    def learnt(self) -> Array:
        """Root of the variance that samples explain, (M, M) lower triangular; its square is B⁻ᵀ (I − Σ) B⁻¹."""
        return solve_lower_right(learnt_root(self.covariance, rounding_of(self.statistics)), self.basis.root)

    def whiten(self, cross: Array) -> Array:
        """Return columns with the explained variance as their square, (M, K).

        cross: covariance of the variables with K quantities, (M, K).
        """
        return self.learnt @ cross

    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Array]) -> Array:
        """Return the covariance of the variables with K quantities of the nonlinear term, (M, K); zero for weights.

        covariance: function that returns the covariance of the term's torques at N motions with the quantities,
        (N n, K). Raise ValueError for another term.
        """
        if term is not self.basis.term:
            raise ValueError("the term does not belong to this posterior")
        inducing = covariance(self.basis.inducing)[self.basis.outputs]
        return np.concatenate([inducing, np.zeros((len(self.basis) - len(inducing), inducing.shape[1]))])

    def with_weights(self, term: LinearKernel, covariance: Array) -> Array:
        """Return the covariance of the variables with K quantities of a linear term, (M, K); zero for all others.

        covariance: cov(w, s), (p, K).
        """
        out = np.zeros((len(self.basis), covariance.shape[1]))
        out[self.basis.rows(term)] = covariance
        return out
