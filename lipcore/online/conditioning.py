"""What a fitted model would know had it seen more samples than its fit stands on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from lipcore.compact.posterior import CompactPosterior
from lipcore.compact.statistics import collect, empty, merge
from lipcore.fitting import FitCancelledError
from lipcore.model import TorqueModel, training_range
from lipcore.samples import Array, Samples

CHUNK = 500
"""Samples whose features are computed together, as in `lipcore.online.learner`."""


def condition(
    model: TorqueModel, samples: Samples, weights: Array | None = None, cancelled: Callable[[], bool] | None = None
) -> TorqueModel:
    """Return the model with the posterior of all these samples, instead of the few that its fit has chosen of them.

    Hyperparameters and basis stay; the statistics are summed anew, so that it does not matter which samples the fit has
    chosen. weights: (N,), one for each sample, all equal where None. Raise FitCancelledError when `cancelled` says so.
    """
    posterior = model.posterior
    motion = samples.motion()
    residual = samples.torque() - posterior.kernel.mean(motion)
    scale = None if weights is None else torch.from_numpy(weights.copy())
    statistics = empty(len(posterior.basis))
    for first in range(0, len(samples), CHUNK):
        if cancelled is not None and cancelled():
            raise FitCancelledError("cancelled while the samples were summed up")
        part = slice(first, first + CHUNK)
        some = None if scale is None else scale[part]
        told = collect(posterior.basis, posterior.noise_variance, motion[part], residual[part], some)
        statistics = merge(statistics, told)
    conditioned = CompactPosterior.build(
        posterior.kernel, posterior.basis, statistics, posterior.noise_variance, posterior.std_factor
    )
    fit = {**model.fit, "samples_posterior": len(samples)}
    return replace(model, posterior=conditioned, fit=fit, training_range=training_range(motion))
