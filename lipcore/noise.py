"""The measurement noise of each joint: where a fit starts, how far it may fall, and what all samples say of it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lipcore.kernels.base import Params, TorqueKernel
from lipcore.linalg import cholesky
from lipcore.motion import Motion
from lipcore.samples import Array, Samples
from lipcore.signals import noise_level

START_SHARE = 0.01
"""Smallest noise std that a fit starts from, relative to the joint's torque spread: what no model explains is noise
too, and filtered torques look free of noise though they are not. Data that deserve less are fitted with less."""
FLOOR_JOINT = 1e-4
FLOOR_ROBOT = 1e-5
"""Smallest noise std admitted, relative to the joint's torque spread and to the largest root mean square of all joints:
below the second, a Gram matrix in float64 can no longer be factored faithfully."""
PRIOR_STD = 1.0
"""Width of the prior on the logarithm: a small data set cannot tell noise from misfit."""
LARGEST_STEP = 0.7
REFINEMENTS = 3
SAMPLES = 250
"""Samples that tell the noise: its estimate is then good to about five per cent."""


def start(samples: Samples) -> Array:
    """Noise std that a fit starts from, (n,) N·m: the white noise of the signals, or a share of their spread."""
    level = noise_level([samples.tau[part] for part in samples.episodes()])
    return np.asarray(np.maximum(level, START_SHARE * samples.tau.std(axis=0)))


def floor(samples: Samples) -> Array:
    """Smallest noise std admitted, (n,) N·m."""
    largest = float(np.sqrt(np.mean(samples.tau**2, axis=0)).max())
    return np.asarray(np.maximum(FLOOR_JOINT * samples.tau.std(axis=0), FLOOR_ROBOT * max(largest, 1e-6)))


def refine(
    kernel: TorqueKernel, params: Params, motion: Motion, tau: Tensor, centre: Tensor, lowest: Tensor
) -> dict[str, Tensor]:
    """Maximise the penalised evidence of more samples over the noise alone, all else held; return new hyperparameters.

    Newton steps on log σ_j. With K = k(X, X) + R and α = K⁻¹y, the evidence falls as ½σ_j²(Σα² − tr K⁻¹) over joint j;
    σ_j² tr K⁻¹ is the number of samples left to tell the noise, after those that the function uses up.

    centre, lowest: (n,) log std of the prior's centre and of the floor. Raise NotPositiveDefiniteError as a fit does.
    """
    n, gram = kernel.n_joints, kernel.symmetric_gram(params, motion)
    y = (tau - kernel.mean(motion)).reshape(-1)
    log_std = params["noise.log_std"]
    for _ in range(REFINEMENTS):
        variance = torch.exp(2 * log_std)
        noisy = gram.clone()
        noisy.diagonal().add_(variance.repeat(len(motion)))
        factor = cholesky(noisy)
        alpha = factor.solve(y).reshape(-1, n)
        free = variance * torch.cholesky_inverse(factor.lower).diagonal().reshape(-1, n).sum(0)
        explained = variance * alpha.square().sum(0)
        slope = explained - free - (log_std - centre) / PRIOR_STD**2
        step = slope / (2 * free + 1 / PRIOR_STD**2)
        log_std = torch.maximum(log_std + step.clamp(-LARGEST_STEP, LARGEST_STEP), lowest)
    return {**params, "noise.log_std": log_std}
