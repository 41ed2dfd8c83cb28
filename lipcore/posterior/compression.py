"""From an exact posterior to a compact one: as few basis functions as answer alike."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from lipcore.data.motion import Array, Motion
from lipcore.data.samples import Samples
from lipcore.kernels.base import Params, SumKernel, TorqueKernel
from lipcore.posterior.basis import Basis, split
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.exact import ExactPosterior, Prediction
from lipcore.posterior.linalg import cholesky, solve_lower
from lipcore.posterior.misfit import Misfit
from lipcore.posterior.selection import Pivots, pivots, spread_out
from lipcore.posterior.statistics import collect

NONE = np.empty(0, np.int64)
"""No inducing outputs."""


@dataclass(frozen=True)
class Deviation:
    """How far a compact posterior lies from the exact one, in the exact one's standard deviations.

    Those of the function, noise excluded and before calibration.

    mean_rms, mean_max: of the mean torque; std_max: largest relative difference of standard deviations; over all joints
    of `queries` motions.
    """

    mean_rms: float
    mean_max: float
    std_max: float
    queries: int

    @classmethod
    def between(cls, exact: Prediction, mean: Array, std: Array, noise_std: Array) -> Deviation:
        """Compare means and standard deviations, (N, n), with the exact prediction. noise_std: (n,)."""
        unit = np.maximum(exact.std, 1e-3 * noise_std)  # what is certain has no deviation of its own
        off, ratio = (mean - exact.mean) / unit, (std - exact.std) / unit
        rms = float(np.sqrt(np.square(off).mean()))
        return cls(rms, float(np.abs(off).max()), float(np.abs(ratio).max()), len(mean))

    def within(self, tolerance: float) -> bool:
        """Whether mean and standard deviation deviate by no more than `tolerance` anywhere."""
        return self.mean_max <= tolerance and self.std_max <= tolerance


@dataclass(frozen=True)
class Compression:
    """A compact posterior, and how near it comes to the exact one. reached: whether it keeps the tolerance asked for.

    deviation: at motions that `checks` draws; tolerance: in standard deviations of the exact one.
    """

    posterior: CompactPosterior
    deviation: Deviation
    tolerance: float
    reached: bool

    def report(self) -> dict[str, float | int | bool]:
        """For the manifest: sizes, tolerance and what was achieved."""
        basis = self.posterior.basis
        sizes = {"inducing_outputs": len(basis.outputs), "inducing_samples": len(basis.inducing), "weights": len(basis)}
        return {**sizes, "tolerance": self.tolerance, "tolerance_reached": self.reached, **asdict(self.deviation)}


def compressed(
    kernel: TorqueKernel, params: Params, samples: Samples, tolerance: float, most: int, std_factor: float
) -> tuple[Compression, float]:
    """The compact posterior of N samples, and the jitter, (N·m)², that the exact one took.

    tolerance, most: as in `compress`; std_factor: calibration of the function's deviation.
    Raise NotPositiveDefiniteError where the exact posterior cannot be computed.
    """
    exact = ExactPosterior.fit(kernel, params, samples.motion(), samples.tau, std_factor)
    return compress(exact, samples.tau, tolerance, most), exact.factor.jitter


def compress(exact: ExactPosterior, tau: Array, tolerance: float, most: int) -> Compression:
    """Smallest compact posterior within `tolerance` of the exact one, or the best with `most` inducing outputs.

    tau: the (N, n) torques that the exact posterior is conditioned on.
    Outputs are taken in the order of pivoted Cholesky; how many, a bisection tells.
    """
    check = checks(exact.motion)
    calibration, exact = exact.std_factor, replace(exact, std_factor=1.0)
    expected = exact.predict(check)
    noise = np.exp(2 * exact.params["noise.log_std"]) + exact.factor.jitter
    candidates = _Candidates.build(exact, tau, noise, check, most)
    sizes = _ladder(candidates.most)
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


def linear(
    kernel: TorqueKernel,
    params: Params,
    samples: Samples,
    variance: Array,
    tolerance: float,
    std_factor: float,
    misfit: Misfit,
) -> Compression:
    """The posterior of a kernel whose terms are all linear, which is compact as it is: nothing is left out.

    samples: N; variance: (N, n) (N·m)², with which each torque teaches; std_factor: calibration. Of the motion, 32
    spread-out instants are kept: to ask the model where it should know.
    """
    motion = samples.motion()
    kept = motion[spread_out(motion, 32)]
    basis = Basis.build(kernel, params, kept, NONE)
    noise = np.exp(2 * params["noise.log_std"])
    statistics = collect(basis, variance, motion, samples.tau - kernel.mean(motion))
    posterior = CompactPosterior.build(kernel, basis, statistics, noise, std_factor, misfit)
    return Compression(posterior, Deviation(0.0, 0.0, 0.0, 0), tolerance, True)


def checks(motion: Motion, queries: int = 200) -> Motion:
    """Motions to compare posteriors at: half of them training samples, half recombined from several.

    A recombined motion takes position, velocity and acceleration from three samples: it lies where the robot has been,
    but was never seen.
    """
    draw, size = np.random.default_rng(0), len(motion)
    seen = draw.permutation(size)[: queries // 2]
    rows = draw.integers(size, size=(3, queries - len(seen)))
    parts = ((motion.q, rows[0]), (motion.dq, rows[1]), (motion.ddq, rows[2]))
    return Motion(*(np.concatenate([values[seen], values[each]]) for values, each in parts))


@dataclass(frozen=True)
class _Candidates:
    """Every prefix of the pivots is a basis: its features are the first rows of the largest one's.

    order: the pivots; a, b: statistics of the largest basis, the linear terms' weights first; features: φ at the
    checks, likewise, (p + most, Q n); variance: prior variances there, (Q, n).
    """

    exact: ExactPosterior
    noise: Array
    order: Pivots
    a: Array
    b: Array
    features: Array
    variance: Array
    mean: Array

    @classmethod
    def build(cls, exact: ExactPosterior, tau: Array, noise: Array, check: Motion, most: int) -> _Candidates:
        kernel, params, motion = exact.kernel, exact.params, exact.motion
        term, linear = split(kernel)
        precision = np.tile(1 / np.sqrt(noise), len(motion))
        weights_only = Basis.build(SumKernel(*linear), params, motion[:0], NONE)
        trained, asked = weights_only.features(motion) * precision, weights_only.features(check)
        order = Pivots(NONE, np.zeros((len(precision), 0)), np.zeros(0))
        if term is not None:
            gram = term.symmetric_gram(params, motion)
            gram *= precision
            gram *= precision[:, None]
            order = pivots(gram, kernel.n_joints, most, 1e-6)  # of the noise's variance
            del gram
            outputs = order.outputs
            samples, places = np.unique(outputs // kernel.n_joints, return_inverse=True)
            cross = term.gram(params, motion[samples], check)[places * kernel.n_joints + outputs % kernel.n_joints]
            root = order.lower[outputs]  # Cholesky factor of the chosen outputs' covariance in units of the noise
            whitened = solve_lower(root, cross * precision[outputs][:, None])
            trained, asked = np.concatenate([trained, order.lower.T]), np.concatenate([asked, whitened])
        residual = (tau - kernel.mean(motion)).reshape(-1) * precision
        variance = kernel.variance(params, check).diagonal(axis1=1, axis2=2)
        return cls(exact, noise, order, trained @ trained.T, trained @ residual, asked, variance, kernel.mean(check))

    @property
    def most(self) -> int:
        return len(self.order)

    def predict(self, count: int) -> tuple[Array, Array]:
        """Mean and standard deviation at the checks with the first `count` pivots, both (Q, n)."""
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


def _ladder(most: int) -> list[int]:
    """Numbers of outputs to choose from, each about 1.05 times the one before, `most` the last."""
    sizes = [most]
    while sizes[-1] > 1:
        sizes.append(min(sizes[-1] - 1, int(sizes[-1] / 1.05)))
    return sizes[::-1]
