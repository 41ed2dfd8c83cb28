"""Gaussian process posteriors of the joint torques: their interface, the exact one, and its evidence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from math import log, pi

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.kernels.base import LinearKernel, Params, TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.posterior.linalg import Factor, add_diagonal, cholesky
from lipcore.vocabulary import Device


@dataclass(frozen=True)
class Prediction:
    """Torque of a function f(q, dq, ddq), without noise. mean: (N, n) N·m; covariance: (N, n, n) (N·m)²."""

    mean: Array
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviation of the function, (N, n) N·m."""
        return np.asarray(np.sqrt(self.covariance.diagonal(axis1=1, axis2=2).clip(0.0)))


@dataclass(frozen=True)
class Posterior(ABC):
    """Gaussian posterior of any quantity that is jointly Gaussian with M anchors u.

    The anchors contain all of the data.

    A quantity s with prior mean E s, prior variance var s and c = cov(u, s) has the posterior mean E s + cᵀ weights and
    the posterior variance var s − |whiten(c)|².
    """

    kernel: TorqueKernel
    """Prior of the torques."""
    params: Params
    """Hyperparameters of the prior."""
    std_factor: float
    """Calibration of every standard deviation that is not noise, see `lipcore.estimators.catalogue`."""
    weights: Array
    """Weights of the anchors, (M,)."""

    @abstractmethod
    def whiten(self, cross: Array) -> Array:
        """Return K columns with the explained variances as squared lengths, (M, K) to (r, K)."""

    @abstractmethod
    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Array]) -> Array:
        """Return the covariance of the anchors with K quantities that belong to one term of the kernel, (M, K).

        covariance: function that returns the covariance of the term's torques at N motions with the quantities,
        (N n, K).
        """

    @abstractmethod
    def with_weights(self, term: LinearKernel, covariance: Array) -> Array:
        """Return the covariance of the anchors with K quantities of a linear term, (M, K).

        term: with p weights; covariance: cov(w, s), (p, K), of its weights with the quantities.
        """

    def cross(self, kernel: TorqueKernel, query: Motion) -> Array:
        """Return the covariance of the anchors with the torques of N queries, or with one term's share, (M, N n).

        kernel: the posterior's own, or a term of it.
        """
        total = np.zeros((len(self.weights), len(query) * kernel.n_joints))
        for term in kernel.terms if isinstance(kernel, SumKernel) else (kernel,):
            if isinstance(term, LinearKernel):
                total += self.with_weights(term, term.variances(self.params)[:, None] * term.flat_features(query).T)
            else:
                total += self.with_torques(term, lambda anchor, k=term: k.gram(self.params, anchor, query))  # type: ignore[misc]
        return total

    def mean(self, query: Motion, component: TorqueKernel | None = None) -> Array:
        """Return the posterior mean torque, (N, n) N·m.

        query: N instants; component: a term of the kernel, to return its share of the mean.
        """
        kernel = component or self.kernel
        return kernel.mean(query) + (self.weights @ self.cross(kernel, query)).reshape(len(query), -1)

    def predict(self, query: Motion, component: TorqueKernel | None = None) -> Prediction:
        """Return the posterior mean (N, n) N·m and covariance (N, n, n) (N·m)² of the torques at each of N queries.

        component: a term of the kernel, to return its share. The covariance is between the joints of one query.
        """
        kernel, n = component or self.kernel, self.kernel.n_joints
        means, covariances = [], []
        for start in range(0, len(query), 128):
            part = query[start : start + 128]
            cross = self.cross(kernel, part)
            means.append(kernel.mean(part) + (self.weights @ cross).reshape(-1, n))
            white = np.ascontiguousarray(self.whiten(cross).reshape(-1, len(part), n).transpose(1, 2, 0))  # (N, n, r)
            explained = white @ white.mT
            covariances.append(self.std_factor**2 * (kernel.variance(self.params, part) - explained))
        return Prediction(np.concatenate(means), np.concatenate(covariances))


@dataclass(frozen=True)
class ExactPosterior(Posterior):
    """Posterior of f given N noisy torques: K = k(X, X) + R, weights α = K⁻¹ y, with one variance in R per joint.

    The anchors are the torques themselves, so cost and memory grow with N. It is the reference for `CompactPosterior`.
    motion: the N training samples; factor: Cholesky of K, (N n, N n); weights: (N n,), sample by sample.
    """

    motion: Motion
    factor: Factor

    @classmethod
    def fit(
        cls, kernel: TorqueKernel, params: Params, motion: Motion, tau: Array, std_factor: float = 1.0
    ) -> ExactPosterior:
        """Return the posterior given measured torques.

        params: hyperparameters, with `noise.log_std`; motion: N samples; tau: (N, n) N·m; std_factor: calibration.
        Raise NotPositiveDefiniteError if K cannot be factored.
        """
        factor = cholesky(noisy_gram(kernel, params, motion))
        weights = factor.solve((tau - kernel.mean(motion)).reshape(-1))
        return cls(kernel, params, std_factor, weights, motion, factor)

    def whiten(self, cross: Array) -> Array:
        """Return L⁻¹ c with K = L Lᵀ."""
        return self.factor.whiten(cross)

    def with_torques(self, term: TorqueKernel, covariance: Callable[[Motion], Array]) -> Array:
        """Return the covariance of the training torques with K quantities of a term, (N n, K)."""
        return covariance(self.motion)

    def with_weights(self, term: LinearKernel, covariance: Array) -> Array:
        """Return Φ(X) cov(w, s), (N n, K). covariance: cov(w, s), (p, K)."""
        return term.flat_features(self.motion) @ covariance


def noisy_gram(kernel: TorqueKernel, params: Params, motion: Motion) -> Array:
    """Return K = k(X, X) + R, (N n, N n), exactly symmetric, sample by sample.

    params: hyperparameters, with `noise.log_std`; motion: N samples.
    """
    gram = kernel.symmetric_gram(params, motion)
    add_diagonal(gram, np.tile(np.exp(2 * params["noise.log_std"]), len(motion)))
    return gram


@dataclass(frozen=True)
class Evidence:
    """Objective of a fit, without its penalty.

    value: −log p(tau | hyperparameters) in nats; gradient: derivative by each hyperparameter.
    """

    value: float
    gradient: dict[str, Array]


def negative_log_evidence(
    kernel: TorqueKernel, params: Params, motion: Motion, tau: Array, device: Device = "cpu"
) -> Evidence:
    """Return ½ yᵀK⁻¹y + ½ log det K + ½ N n log 2π with K = k(X, X) + R, and its gradient.

    The gradient is the sum of W ∘ ∂K with W = ½ (K⁻¹ − ααᵀ), α = K⁻¹y (Rasmussen & Williams, eq. 5.9). y is the torque
    minus its prior mean. W is a constant once K is factored, so each kernel differentiates Σ W ∘ K in its own way.

    motion: N samples; tau: (N, n); device: to compute on. Raise NotPositiveDefiniteError if K cannot be factored.
    """
    if device != "cpu":
        from lipcore.posterior.on_device import evidence_on  # noqa: PLC0415 - it imports torch

        return Evidence(*evidence_on(kernel, params, motion, tau, device))
    n, size = kernel.n_joints, len(motion)
    factor = cholesky(noisy_gram(kernel, params, motion))
    y = (tau - kernel.mean(motion)).reshape(-1)
    alpha = factor.solve(y)
    value = 0.5 * (y @ alpha) + 0.5 * factor.log_determinant() + 0.5 * len(y) * log(2 * pi)
    weight = 0.5 * (factor.inverse() - np.outer(alpha, alpha))
    gradient = kernel.gradient(params, motion, weight)
    noise = np.exp(2 * params["noise.log_std"])
    gradient["noise.log_std"] = 2 * noise * weight.diagonal().reshape(size, n).sum(0)
    return Evidence(float(value), gradient)
