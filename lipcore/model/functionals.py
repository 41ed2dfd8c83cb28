"""Posteriors of quantities that are jointly Gaussian with torques: sums and differences of torques, and energies.

Energies are learnt without a measurement of either (eq. 2 of docs/method.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.kernels.arm import ArmKernel
from lipcore.kernels.base import Params, State, TorqueKernel, row_chunks
from lipcore.kernels.chain import ChainKernel
from lipcore.kernels.lip import LipKernel
from lipcore.kernels.payload import PayloadKernel
from lipcore.posterior.exact import Posterior

RigidKernel = ArmKernel | PayloadKernel
"""Kernels with energies that are linear in weights."""
EnergyKernel = LipKernel | ChainKernel | RigidKernel
"""Priors of torques that are derived from priors of energies."""
KINETIC, POTENTIAL = 0, 1


@dataclass(frozen=True)
class Estimate:
    """Posterior mean and standard deviation of a quantity at N queries, both (N, ...), without noise."""

    mean: Array
    std: Array


def condition(posterior: Posterior, prior_mean: Array, prior_variance: Array, cross: Array) -> Estimate:
    """Return the posterior of K quantities from their covariance with the posterior's anchors (see `Posterior`).

    prior_mean, prior_variance: (K,); cross: (M, K).
    """
    explained = np.square(posterior.whiten(cross)).sum(0)
    std = np.sqrt((prior_variance - explained).clip(0.0))  # rounding may give less than zero
    return Estimate(prior_mean + posterior.weights @ cross, posterior.std_factor * std)


@dataclass(frozen=True)
class Combination:
    """F linear combinations of a kernel's torques at S motions per query.

    motions: S motions of N queries each, with deflections in all or none; coefficients: (F, S n), motion by motion.
    """

    kernel: TorqueKernel
    motions: Sequence[Motion]
    coefficients: Array

    def prior(self, posterior: Posterior, rows: slice) -> tuple[Array, Array, Array]:
        """Return prior mean and variance, (R, F), and covariance with the posterior's anchors, (M, R F), at R rows."""
        size, kernel = len(self.motions), self.kernel
        stacked = np.stack([motion[rows].arrays() for motion in self.motions], axis=1)  # (R, S, 3, n), or wider
        stack = Motion.of(stacked.reshape(-1, *stacked.shape[2:]))
        cross = posterior.cross(kernel, stack).reshape(-1, size * kernel.n_joints) @ self.coefficients.T
        starts = range(0, len(stack), size)
        grams = [kernel.symmetric_gram(posterior.params, stack[start : start + size]) for start in starts]
        variance = np.stack([(self.coefficients @ gram * self.coefficients).sum(1) for gram in grams])
        mean = kernel.mean(stack).reshape(len(grams), -1) @ self.coefficients.T
        return mean, variance, cross.reshape(len(posterior.weights), -1)


def combine_torques(
    posterior: Posterior, kernel: TorqueKernel, motions: Sequence[Motion], coefficients: Array
) -> Estimate:
    """Return the posterior of one `Combination`, (N, F).

    It is computed from the joint posterior of all S n torques. What they have in common cancels in a difference, also
    in its uncertainty.
    """
    return add_combinations(posterior, [Combination(kernel, motions, coefficients)])


def add_combinations(posterior: Posterior, parts: Sequence[Combination]) -> Estimate:
    """Return the posterior of a sum of combinations of different terms of the kernel, (N, F).

    The terms are independent a priori. The posterior's covariances between them are included.
    """
    count = len(parts[0].motions[0])
    # right-hand sides are whitened together: enough for fast matrix products, few enough for tens of MB
    step = max(1, 512 // (parts[0].coefficients.shape[1]))
    means, stds = [], []
    for start in range(0, count, step):
        found = [part.prior(posterior, slice(start, start + step)) for part in parts]
        mean, variance, cross = (sum(each[1:], each[0]) for each in zip(*found, strict=True))
        estimate = condition(posterior, mean.reshape(-1), variance.reshape(-1), cross)
        means.append(estimate.mean.reshape(mean.shape))
        stds.append(estimate.std.reshape(mean.shape))
    return Estimate(np.concatenate(means), np.concatenate(stds))


def kinetic_energy(posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion) -> Estimate:
    """Return the posterior of the kinetic energy at N queries, summed over kernels, (N,) J (docs/method.md, eq. 2)."""
    mean = prior_mean(kernels, query)[KINETIC]
    variance = covariance(posterior.params, kernels, query, query)[KINETIC]
    return condition(posterior, mean, variance, with_anchors(posterior, kernels, query)[KINETIC])


def potential_energy(
    posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion, reference: Array
) -> Estimate:
    """Return the posterior of V(q) − V(reference) at N queries, summed over the kernels, (N,) J. reference: (n,).

    Torques do not determine the constant of V: only a difference has a useful uncertainty.
    """
    params, zero = posterior.params, np.zeros_like(reference)[None]
    origin = Motion(reference[None], zero, zero)
    variance = (
        covariance(params, kernels, query, query)
        - 2 * covariance(params, kernels, query, origin)
        + covariance(params, kernels, origin, origin)
    )
    mean = prior_mean(kernels, query) - prior_mean(kernels, origin)
    cross = with_anchors(posterior, kernels, query) - with_anchors(posterior, kernels, origin)
    return condition(posterior, mean[POTENTIAL], variance[POTENTIAL], cross[POTENTIAL])


def prior_mean(kernels: Sequence[EnergyKernel], query: Motion) -> Array:
    """Return the prior means of kinetic and potential energy at N queries, summed over the kernels, (2, N) J."""
    total = np.zeros((2, len(query)))
    for kernel in kernels:
        if isinstance(kernel, RigidKernel) and (weights := kernel.prior_weights()) is not None:
            total += (kernel.energy_features(query) @ weights).T
    return total


def covariance(params: Params, kernels: Sequence[EnergyKernel], x: Motion, y: Motion) -> Array:
    """Return the prior covariance of each energy at sample k of x with the same energy at sample k of y, (2, N) J².

    x, y: N samples each; y may be a single sample, which is then used for every k.
    """
    total = np.zeros((2, len(x)))
    for kernel in kernels:
        if isinstance(kernel, RigidKernel):
            scaled = kernel.energy_features(x) * kernel.variances(params)
            total += (scaled * kernel.energy_features(y)).sum(2).T
        else:
            total += kernel.energy_covariance(params, State.paired(x), State.paired(y))
    return total


def with_anchors(posterior: Posterior, kernels: Sequence[EnergyKernel], query: Motion) -> Array:
    """Return the prior covariance of both energies at N queries with the posterior's M anchors, (2, M, N) (eq. 2)."""
    total = np.zeros((2, len(posterior.weights), len(query)))
    for kernel in kernels:
        if isinstance(kernel, RigidKernel):
            scaled = kernel.energy_features(query) * kernel.variances(posterior.params)  # (N, 2, p)
            parts = [posterior.with_weights(kernel, scaled[:, energy].T) for energy in (KINETIC, POTENTIAL)]
        else:
            anchors = posterior.with_torques(kernel, partial(_with_torques, kernel, posterior.params, query))
            parts = list(anchors.reshape(len(anchors), 2, -1).transpose(1, 0, 2))
        total += np.stack(parts)
    return total


def _with_torques(kernel: LipKernel | ChainKernel, params: Params, query: Motion, motion: Motion) -> Array:
    """Return the covariance of all torques of S samples with both energies at N queries, (S n, 2 N)."""
    n, size, columns = kernel.n_joints, len(motion), State.columns(motion)
    out = np.empty((size, n, 2, len(query)))
    for rows in row_chunks(len(query), size):
        cross = kernel.energies(params, State.rows(query[rows]), columns)  # (2, n, rows, S)
        out[..., rows] = cross.transpose(3, 1, 0, 2)
    return out.reshape(size * n, -1)
