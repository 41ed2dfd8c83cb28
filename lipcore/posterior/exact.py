"""Gaussian process posteriors of the joint torques: what all have in common, the exact one, and its evidence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import log, pi

import torch
from torch import Tensor

from lipcore.data.motion import Motion
from lipcore.kernels.base import LinearKernel, Params, SumKernel, TorqueKernel
from lipcore.posterior.linalg import Factor, cholesky

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
class Posterior(ABC):
    """What is known of anything jointly Gaussian with M anchors u, which hold all that the data say.

    A quantity s with prior mean E s, prior variance var s and c = cov(u, s) has the posterior mean E s + cᵀ weights and
    the posterior variance var s − |whiten(c)|².

    kernel: prior of the torques; params: its hyperparameters; std_factor: calibration of every standard deviation that
    is not noise (see `fitting.estimators`); weights: (M,).
    """

    kernel: TorqueKernel
    params: Params
    std_factor: float
    weights: Tensor

    @abstractmethod
    def whiten(self, cross: Tensor) -> Tensor:
        """Columns whose squared length is what the data explain: (M, K) to (r, K)."""

    @abstractmethod
    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Tensor]) -> Tensor:
        """Covariance of the anchors with K quantities that belong to one term of the kernel: (M, K).

        covariance: that of the term's torques at N motions with the quantities, (N n, K).
        """

    @abstractmethod
    def with_weights(self, term: LinearKernel, covariance: Tensor) -> Tensor:
        """Covariance of the anchors with K quantities, from that of a linear term's weights with them.

        term: with p weights; covariance: cov(w, s), (p, K). Return cov(u, s), (M, K).
        """

    def cross(self, kernel: TorqueKernel, query: Motion) -> Tensor:
        """Covariance of the anchors with all torques of N queries, or with one term's share of them: (M, N n).

        kernel: the posterior's own, or a term of it.
        """
        total = torch.zeros((len(self.weights), len(query) * kernel.n_joints), dtype=torch.float64)
        for term in kernel.terms if isinstance(kernel, SumKernel) else (kernel,):
            if isinstance(term, LinearKernel):
                features = term.features(query)
                scaled = term.covariance(self.params) @ features.reshape(-1, features.shape[-1]).T
                total += self.with_weights(term, scaled)
            else:
                total += self.with_torques(term, lambda anchor, k=term: k.gram(self.params, anchor, query))  # type: ignore[misc]
        return total

    def mean(self, query: Motion, component: TorqueKernel | None = None) -> Tensor:
        """Posterior mean torque, (N, n) N·m.

        query: N instants; component: a term of the kernel, whose share of the mean is asked for.
        """
        kernel = component or self.kernel
        return kernel.mean(query) + (self.weights @ self.cross(kernel, query)).reshape(len(query), -1)

    def predict(self, query: Motion, component: TorqueKernel | None = None) -> Prediction:
        """Posterior mean (N, n) N·m and covariance (N, n, n) (N·m)² of the torques at each of N queries.

        component: a term of the kernel, whose share is asked for. The covariance is that between the joints of one
        query.
        """
        kernel, n = component or self.kernel, self.kernel.n_joints
        means, covariances = [], []
        for start in range(0, len(query), QUERIES_PER_CHUNK):
            part = query[start : start + QUERIES_PER_CHUNK]
            cross = self.cross(kernel, part)
            means.append(kernel.mean(part) + (self.weights @ cross).reshape(-1, n))
            white = self.whiten(cross).reshape(-1, len(part), n)
            explained = torch.einsum("kmi,kmj->mij", white, white)
            covariances.append(self.std_factor**2 * (kernel.variance(self.params, part) - explained))
        return Prediction(torch.cat(means), torch.cat(covariances))


@dataclass(frozen=True)
class ExactPosterior(Posterior):
    """Posterior of f given N noisy torques: K = k(X, X) + R, weights α = K⁻¹ y, with R one variance a joint.

    The anchors are the torques themselves, so cost and memory grow with N: the reference for `CompactPosterior`.
    motion: the N training samples; factor: Cholesky of K, (N n, N n); weights: (N n,), sample by sample.
    """

    motion: Motion
    factor: Factor

    @classmethod
    def fit(
        cls, kernel: TorqueKernel, params: Params, motion: Motion, tau: Tensor, std_factor: float = 1.0
    ) -> ExactPosterior:
        """Condition the prior on measured torques.

        params: hyperparameters, `noise.log_std` among them; motion: N samples; tau: (N, n) N·m; std_factor:
        calibration. Raise NotPositiveDefiniteError where K cannot be factored.
        """
        factor = cholesky(noisy_gram(kernel, params, motion))
        weights = factor.solve((tau - kernel.mean(motion)).reshape(-1))
        return cls(kernel, params, std_factor, weights, motion, factor)

    def whiten(self, cross: Tensor) -> Tensor:
        """L⁻¹ c with K = L Lᵀ."""
        return self.factor.whiten(cross)

    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Tensor]) -> Tensor:
        """Covariance of the training torques with K quantities, from that of a term's torques: (N n, K)."""
        return covariance(self.motion)

    def with_weights(self, term: LinearKernel, covariance: Tensor) -> Tensor:
        """Φ(X) cov(w, s), (N n, K). covariance: cov(w, s), (p, K)."""
        features = term.features(self.motion)
        return features.reshape(-1, features.shape[-1]) @ covariance


def noisy_gram(kernel: TorqueKernel, params: Params, motion: Motion) -> Tensor:
    """K = k(X, X) + R: (N n, N n), exactly symmetric, sample by sample.

    params: hyperparameters, `noise.log_std` among them; motion: N samples.
    """
    gram = kernel.symmetric_gram(params, motion)
    gram.diagonal().add_(torch.exp(2 * params["noise.log_std"]).repeat(len(motion)))
    return gram


@dataclass(frozen=True)
class Evidence:
    """value: −log p(tau | hyperparameters) in nats; gradient: its derivative by each hyperparameter."""

    value: float
    gradient: dict[str, Tensor]


def negative_log_evidence(kernel: TorqueKernel, params: Params, motion: Motion, tau: Tensor) -> Evidence:
    """½ yᵀK⁻¹y + ½ log det K + ½ N n log 2π with K = k(X, X) + R, and its gradient.

    The gradient is the sum of W ∘ ∂K with W = ½ (K⁻¹ − ααᵀ), α = K⁻¹y (Rasmussen & Williams, eq. 5.9); y is what the
    prior mean leaves. W is a constant once K is factored, so each kernel differentiates Σ W ∘ K in its own way.

    motion: N samples; tau: (N, n). Raise NotPositiveDefiniteError where K cannot be factored.
    """
    n, size = kernel.n_joints, len(motion)
    factor = cholesky(noisy_gram(kernel, params, motion))
    y = (tau - kernel.mean(motion)).reshape(-1)
    alpha = factor.solve(y)
    value = 0.5 * (y @ alpha) + 0.5 * factor.log_determinant() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (torch.cholesky_inverse(factor.lower) - torch.outer(alpha, alpha))
    gradient = kernel.gradient(params, motion, weight)
    noise = torch.exp(2 * params["noise.log_std"])
    gradient["noise.log_std"] = 2 * noise * weight.diagonal().reshape(size, n).sum(0)
    return Evidence(float(value), gradient)
