"""Compression of an exact posterior to a compact one with as few basis functions as the tolerance allows."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.data.samples import Samples
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.kernels.combined import SumKernel
from lipcore.posterior.basis import Basis, split
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.exact import ExactPosterior, Prediction
from lipcore.posterior.linalg import cholesky, solve_lower
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.selection import Pivots, pivots, spread_out
from lipcore.posterior.statistics import collect

NO_OUTPUTS = np.empty(0, np.int64)
"""No inducing outputs."""


@dataclass(frozen=True)
class Deviation:
    """Difference of a compact posterior from the exact one, over all joints of `queries` motions.

    The unit is the exact posterior's standard deviation of the function, without noise and before calibration.
    """

    mean_rms: float
    """Root mean square difference of the mean torque."""
    mean_max: float
    """Max difference of the mean torque."""
    std_max: float
    """Max relative difference of the standard deviations."""
    queries: int
    """Number of motions compared."""

    @classmethod
    def between(cls, exact: Prediction, mean: Array, std: Array, noise_std: Array) -> Deviation:
        """Return the deviation of means and standard deviations, (N, n), from the exact prediction. noise_std: (n,)."""
        unit = np.maximum(exact.std, 1e-3 * noise_std)  # a certain torque has a std of zero
        off, ratio = (mean - exact.mean) / unit, (std - exact.std) / unit
        rms = float(np.sqrt(np.square(off).mean()))
        return cls(rms, float(np.abs(off).max()), float(np.abs(ratio).max()), len(mean))

    def within(self, tolerance: float) -> bool:
        """Return whether mean and standard deviation differ by at most `tolerance` everywhere."""
        return self.mean_max <= tolerance and self.std_max <= tolerance


@dataclass(frozen=True)
class Compression:
    """A compact posterior and its deviation from the exact one."""

    posterior: CompactPosterior
    """The compact posterior."""
    deviation: Deviation
    """Deviation at the motions of `checks`."""
    tolerance: float
    """Requested max deviation, in standard deviations of the exact posterior."""
    reached: bool
    """Whether the deviation is within the tolerance."""

    def report(self) -> dict[str, float | int | bool]:
        """Return sizes, tolerance and achieved deviation for the manifest."""
        basis = self.posterior.basis
        sizes = {"inducing_outputs": len(basis.outputs), "inducing_samples": len(basis.inducing), "weights": len(basis)}
        return {**sizes, "tolerance": self.tolerance, "tolerance_reached": self.reached, **asdict(self.deviation)}


def compress_samples(
    kernel: TorqueKernel, params: Params, samples: Samples, tolerance: float, most: int, std_factor: float
) -> tuple[Compression, float]:
    """Return the compact posterior of N samples, and the jitter of the exact one, (N·m)².

    tolerance, most: as in `compress`; std_factor: calibration of the function's standard deviation. Raise
    NotPositiveDefiniteError if the exact posterior cannot be computed.
    """
    exact = ExactPosterior.fit(kernel, params, samples.motion(), samples.tau, std_factor)
    return compress(exact, samples.tau, tolerance, most), exact.factor.jitter


def compress(exact: ExactPosterior, tau: Array, tolerance: float, most: int) -> Compression:
    """Return the smallest compact posterior within `tolerance` of the exact one, or the best with `most` outputs.

    tau: (N, n), the torques that the exact posterior is conditioned on. Outputs are added in the order of pivoted
    Cholesky. A bisection finds their number.
    """
    check = checks(exact.motion)
    calibration, exact = exact.std_factor, replace(exact, std_factor=1.0)
    expected = exact.predict(check)
    noise = np.exp(2 * exact.params["noise.log_std"]) + exact.factor.jitter
    candidates = _Candidates.build(exact, tau, noise, check, most)
    sizes = _candidate_sizes(candidates.most)
    low, high = 0, len(sizes) - 1
    while low < high:
        middle = (low + high) // 2
        if Deviation.between(expected, *candidates.predict(sizes[middle]), np.sqrt(noise)).within(tolerance):
            high = middle
        else:
            low = middle + 1
    posterior = candidates.posterior(sizes[high], tau)
    answer = posterior.predict(check)
    deviation = Deviation.between(expected, answer.mean, answer.std, np.sqrt(noise))
    return Compression(replace(posterior, std_factor=calibration), deviation, tolerance, deviation.within(tolerance))


def build_linear(
    kernel: TorqueKernel,
    params: Params,
    samples: Samples,
    variance: Array,
    tolerance: float,
    std_factor: float,
    misfit: Misfit,
) -> Compression:
    """Return the posterior of a kernel with linear terms only. It is compact by itself: nothing is approximated.

    samples: N; variance: (N, n) (N·m)², of each torque when it is learnt; std_factor: calibration. 32 spread-out
    instants of the motion are kept as queries near the training data.
    """
    motion = samples.motion()
    kept = motion[spread_out(motion, 32)]
    basis = Basis.build(kernel, params, kept, NO_OUTPUTS)
    noise = np.exp(2 * params["noise.log_std"])
    statistics = collect(basis, variance, motion, samples.tau - kernel.mean(motion))
    posterior = CompactPosterior.build(kernel, basis, statistics, noise, std_factor, misfit)
    return Compression(posterior, Deviation(0.0, 0.0, 0.0, 0), tolerance, True)


def checks(motion: Motion, queries: int = 200) -> Motion:
    """Return motions for comparing posteriors: one half training samples, one half recombined from several samples.

    A recombined motion has the position, velocity and acceleration of three samples. It is in the region of the
    training motion, but it is new.
    """
    draw, size = np.random.default_rng(0), len(motion)
    seen = draw.permutation(size)[: queries // 2]
    rows = draw.integers(size, size=(3, queries - len(seen)))
    parts = ((motion.q, rows[0]), (motion.dq, rows[1]), (motion.ddq, rows[2]))
    return Motion(*(np.concatenate([values[seen], values[each]]) for values, each in parts))


@dataclass(frozen=True)
class _Candidates:
    """Bases of all sizes: every prefix of the pivots is a basis.

    Its features are the first rows of the largest one's.
    """

    exact: ExactPosterior
    """Exact posterior, before calibration."""
    noise: Array
    """Noise variance, (n,) (N·m)²."""
    order: Pivots
    """Pivots."""
    a: Array
    """A of the largest basis, the weights of the linear terms first."""
    b: Array
    """b of the largest basis, likewise."""
    features: Array
    """φ at the checks, the weights of the linear terms first, (p + most, Q n)."""
    variance: Array
    """Prior variances at the checks, (Q, n)."""
    mean: Array
    """Prior means at the checks, (Q, n)."""

    @classmethod
    def build(cls, exact: ExactPosterior, tau: Array, noise: Array, check: Motion, most: int) -> _Candidates:
        kernel, params, motion = exact.kernel, exact.params, exact.motion
        term, linear = split(kernel)
        precision = np.tile(1 / np.sqrt(noise), len(motion))
        weights_only = Basis.build(SumKernel(*linear), params, motion[:0], NO_OUTPUTS)
        trained, asked = weights_only.features(motion) * precision, weights_only.features(check)
        order = Pivots(NO_OUTPUTS, np.zeros((len(precision), 0)), np.zeros(0))
        if term is not None:
            gram = term.symmetric_gram(params, motion)
            gram *= precision
            gram *= precision[:, None]
            order = pivots(gram, kernel.n_joints, most, 1e-6)  # relative to the noise variance
            del gram
            outputs = order.outputs
            samples, places = np.unique(outputs // kernel.n_joints, return_inverse=True)
            cross = term.gram(params, motion[samples], check)[places * kernel.n_joints + outputs % kernel.n_joints]
            root = order.lower[outputs]  # Cholesky factor of the chosen outputs' covariance, relative to the noise
            whitened = solve_lower(root, cross * precision[outputs][:, None])
            trained, asked = np.concatenate([trained, order.lower.T]), np.concatenate([asked, whitened])
        residual = (tau - kernel.mean(motion)).reshape(-1) * precision
        variance = kernel.variance(params, check).diagonal(axis1=1, axis2=2)
        return cls(exact, noise, order, trained @ trained.T, trained @ residual, asked, variance, kernel.mean(check))

    @property
    def most(self) -> int:
        return len(self.order)

    def predict(self, count: int) -> tuple[Array, Array]:
        """Return mean and standard deviation at the checks with the first `count` pivots, both (Q, n)."""
        used = len(self.a) - self.most + count
        features = self.features[:used]
        factor = cholesky(np.eye(used) + self.a[:used, :used])
        mean = self.mean + (factor.solve(self.b[:used]) @ features).reshape(self.mean.shape)
        explained = np.square(features).sum(0) - np.square(factor.whiten(features)).sum(0)
        variance = self.variance - explained.reshape(self.variance.shape)
        return mean, np.sqrt(variance.clip(0.0))

    def posterior(self, count: int, tau: Array) -> CompactPosterior:
        exact, n = self.exact, self.exact.kernel.n_joints
        outputs = self.order.outputs[:count]
        samples, places = np.unique(outputs // n, return_inverse=True)
        basis = Basis.build(exact.kernel, exact.params, exact.motion[samples], places * n + outputs % n)
        residual = tau - exact.kernel.mean(exact.motion)
        statistics = collect(basis, self.noise, exact.motion, residual)
        return CompactPosterior.build(exact.kernel, basis, statistics, self.noise)


def _candidate_sizes(most: int) -> list[int]:
    """Return the candidate numbers of outputs, each about 1.05 times the one before, up to `most`."""
    sizes = [most]
    while sizes[-1] > 1:
        sizes.append(min(sizes[-1] - 1, int(sizes[-1] / 1.05)))
    return sizes[::-1]
