"""The measurement noise of each joint: starting value of a fit, min value, and estimate from all samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lipcore.data.motion import Motion
from lipcore.data.samples import Array, Samples
from lipcore.data.signals import noise_level
from lipcore.kernels.base import Params, TorqueKernel
from lipcore.posterior.linalg import add_diagonal, cholesky


@dataclass(frozen=True)
class NoiseOptions:
    """Limits of a joint's noise, and the effort of its estimate."""

    start_share: float = 0.01
    """Min noise std that a fit starts from, relative to the joint's torque spread. Torque that no model explains is
    noise too, and filtered torques only look free of noise. A fit to cleaner data ends with less."""
    min_joint_share: float = 1e-4
    min_robot_share: float = 1e-5
    """Min noise std, relative to the joint's torque spread and to the max root mean square of all joints. Below the
    second, a Gram matrix in float64 can no longer be factored accurately."""
    prior_std: float = 1.0
    """Standard deviation of the prior on the logarithm: few data cannot distinguish noise from misfit."""
    max_step: float = 0.7
    max_newton_steps: int = 8
    converged_step: float = 0.01
    max_widenings: int = 3
    stretches: int = 25
    """Contiguous parts of the samples that are held out one after another."""
    chance_ratio: float = 1.15
    """Ratio of squared error to expected variance that chance explains."""
    samples: int = 250
    """Max samples of the estimate, which is then accurate to about five per cent."""


OPTIONS = NoiseOptions()


def white(samples: Samples, stretches: Samples | None = None) -> Array:
    """Return the standard deviation of the white noise of the torque signals, (n,) N·m.

    stretches: contiguous samples, used if `samples` are thinned, because differences of thinned samples contain motion.
    """
    signals = samples if stretches is None else stretches
    return noise_level([signals.tau[part] for part in signals.episodes()])


def start(samples: Samples, stretches: Samples | None = None) -> Array:
    """Return the noise std that a fit starts from, (n,) N·m: the white noise of signals, or a share of their spread.

    stretches: see `white`.
    """
    level = white(samples, stretches)
    return np.asarray(np.maximum.reduce([level, OPTIONS.start_share * samples.tau.std(axis=0), floor(samples)]))


def floor(samples: Samples) -> Array:
    """Return the min noise std for these samples, (n,) N·m."""
    largest = float(np.sqrt(np.mean(samples.tau**2, axis=0)).max())
    return np.asarray(
        np.maximum(OPTIONS.min_joint_share * samples.tau.std(axis=0), OPTIONS.min_robot_share * max(largest, 1e-6))
    )


def refine(
    kernel: TorqueKernel, params: Params, motion: Motion, tau: Array, centre: Array, lowest: Array
) -> dict[str, Array]:
    """Return the hyperparameters with the noise estimated again from some samples, in two steps.

    First the penalised evidence is maximised over the noise by Newton steps on log σ_j. With K = k(X, X) + R and
    α = K⁻¹y, its slope is σ_j²(Σα² − tr K⁻¹) over joint j. σ_j² tr K⁻¹ is the number of samples that determine the
    noise, without those that the function uses up.

    Then contiguous stretches are held out one after another and predicted from the rest. If the errors are larger than
    the model expects, the noise is raised. This happens if filtered noise lasts over several samples and was attributed
    to the function.

    centre, lowest: (n,), log std of the prior's centre and of the floor. Raise NotPositiveDefiniteError as a fit does.
    """
    n, gram = kernel.n_joints, kernel.symmetric_gram(params, motion)
    y = (tau - kernel.mean(motion)).reshape(-1)
    log_std = params["noise.log_std"]
    for _ in range(OPTIONS.max_newton_steps):
        inverse, alpha = _inverse(gram, log_std, y)
        variance = np.exp(2 * log_std)
        free = variance * inverse.diagonal().reshape(-1, n).sum(0)
        explained = variance * np.square(alpha.reshape(-1, n)).sum(0)
        slope = explained - free - (log_std - centre) / OPTIONS.prior_std**2
        step = (slope / (2 * free + 1 / OPTIONS.prior_std**2)).clip(-OPTIONS.max_step, OPTIONS.max_step)
        before, log_std = log_std, np.maximum(log_std + step, lowest)
        if (np.abs(log_std - before) < OPTIONS.converged_step).all():
            break
    for _ in range(OPTIONS.max_widenings):
        excess = _cross_validate(*_inverse(gram, log_std, y), n)
        if (excess <= OPTIONS.chance_ratio).all():
            break
        log_std = log_std + np.where(
            excess > OPTIONS.chance_ratio, 0.5 * np.log(excess.clip(OPTIONS.chance_ratio)), 0.0
        ).clip(max=OPTIONS.max_step)
    return {**params, "noise.log_std": log_std}


def _inverse(gram: Array, log_std: Array, y: Array) -> tuple[Array, Array]:
    """Return K⁻¹ and α = K⁻¹y."""
    noisy = gram.copy()
    add_diagonal(noisy, np.tile(np.exp(2 * log_std), len(y) // len(log_std)))
    factor = cholesky(noisy)
    return factor.inverse(), factor.solve(y)


def _cross_validate(inverse: Array, alpha: Array, n: int) -> Array:
    """Return the mean squared error over predicted variance, (n,), each stretch predicted from all others.

    If block B is held out, the error is [K⁻¹]_BB⁻¹ α_B and its covariance [K⁻¹]_BB⁻¹ (Rasmussen & Williams, eq. 5.12).
    """
    ratios = []
    for block in np.array_split(np.arange(len(alpha)).reshape(-1, n), OPTIONS.stretches):
        rows = block.reshape(-1)
        covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
        ratios.append((np.square(covariance @ alpha[rows]) / covariance.diagonal()).reshape(-1, n))
    return np.asarray(np.concatenate(ratios).mean(0))
