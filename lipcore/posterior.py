"""The exact multi-output Gaussian process posterior of the joint torques."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lipcore.kernels.base import Params, TorqueKernel
from lipcore.linalg import Factor, cholesky
from lipcore.motion import Motion

QUERIES_PER_CHUNK = 128


@dataclass(frozen=True)
class Prediction:
    """Torque of a function f(q, dq, ddq), noise excluded. mean: (N, n) N·m; covariance: (N, n, n) (N·m)²."""

    mean: Tensor
    covariance: Tensor

    @property
    def std(self) -> Tensor:
        """Standard deviation of the function, (N, n) N·m."""
        return self.covariance.diagonal(dim1=1, dim2=2).clamp_min(0.0).sqrt()


@dataclass(frozen=True)
class ExactPosterior:
    """Posterior of f given N noisy torques: K = k(X, X) + R, weights α = K⁻¹ y, with R one variance a joint.

    motion: the N training samples; factor: Cholesky of K, (N n, N n); weights: (N n,), sample by sample; std_factor:
    calibration of every standard deviation that is not noise (see `calibration`).
    """

    kernel: TorqueKernel
    params: Params
    motion: Motion
    factor: Factor
    weights: Tensor
    std_factor: float = 1.0

    @classmethod
    def fit(
        cls, kernel: TorqueKernel, params: Params, motion: Motion, tau: Tensor, std_factor: float = 1.0
    ) -> ExactPosterior:
        """Condition the prior on torques tau (N, n) at `motion`; raise NotPositiveDefiniteError if K is singular."""
        factor = cholesky(noisy_gram(kernel, params, motion))
        return cls(kernel, params, motion, factor, factor.solve((tau - kernel.mean(motion)).reshape(-1)), std_factor)

    def mean(self, query: Motion, component: TorqueKernel | None = None) -> Tensor:
        """Posterior mean torque, (N, n) N·m; with `component`, a term of the kernel, that term's share of it."""
        kernel = component or self.kernel
        learnt = (kernel.gram(self.params, query, self.motion) @ self.weights).reshape(len(query), -1)
        return kernel.mean(query) + learnt

    def predict(self, query: Motion, component: TorqueKernel | None = None) -> Prediction:
        """Posterior mean and n×n covariance of the torques at each of N queries, or of one term of the kernel."""
        kernel, n = component or self.kernel, self.kernel.n_joints
        means, covariances = [], []
        for start in range(0, len(query), QUERIES_PER_CHUNK):
            part = query[start : start + QUERIES_PER_CHUNK]
            cross = kernel.gram(self.params, self.motion, part)  # (N n, M n)
            means.append(kernel.mean(part) + (self.weights @ cross).reshape(-1, n))
            white = self.factor.whiten(cross).reshape(-1, len(part), n)
            explained = torch.einsum("kmi,kmj->mij", white, white)
            covariances.append(self.std_factor**2 * (kernel.variance(self.params, part) - explained))
        return Prediction(torch.cat(means), torch.cat(covariances))


def noisy_gram(kernel: TorqueKernel, params: Params, motion: Motion) -> Tensor:
    """k(X, X) + R: (N n, N n), exactly symmetric."""
    gram = kernel.symmetric_gram(params, motion)
    gram.diagonal().add_(torch.exp(2 * params["noise.log_std"]).repeat(len(motion)))
    return gram
