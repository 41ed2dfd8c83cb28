"""Conditioning of a fitted model on all samples, beyond those of its fit, in one pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lipcore.data.samples import Array, Samples
from lipcore.estimators.hyperparameters import FitCancelledError
from lipcore.estimators.options import FitOptions
from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.compact import CompactPosterior
from lipcore.posterior.linalg import unpack_symmetric
from lipcore.posterior.statistics import Statistics
from lipcore.posterior.summing import CHUNK, Summing, Total

SHARD = 2048
"""Samples of one shard, which one worker sums up: about a second of one core for seven joints."""


@dataclass(frozen=True)
class ShardStatistics:
    """Sums over some samples for a model, as plain arrays for transfer between processes.

    Add them in one fixed order for bit-identical sums.
    """

    a: Array
    """Upper triangle of the statistics' A row by row, (M (M + 1) / 2,)."""
    b: Array
    """b, (M,)."""
    weight: float
    """Sum of the samples' weights."""
    low: Array
    """Min q, dq and ddq, (3, n)."""
    high: Array
    """Max q, dq and ddq, (3, n)."""

    def __add__(self, other: ShardStatistics) -> ShardStatistics:
        return ShardStatistics(
            self.a + other.a,
            self.b + other.b,
            self.weight + other.weight,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )


def should_condition(options: FitOptions, count: int, independent: float) -> bool:
    """Return whether to condition a posterior on all `count` samples, and not only on those chosen by the fit.

    independent: number of effective samples. Measured (`all_rows.py panda` of benchmarks/studies) on a simulated Panda
    with friction that no estimator models, of 100 to 1000 s at 10 Hz to 1 kHz: if all samples counted more, their nMSE
    was 0.58 to 1.04 times that of the 500 chosen ones, and 95 % intervals covered 93 to 98 % instead of 93 to 96 %.
    With weight one instead of weights by time, 100 s of slow motion at 1 kHz covered 85 %.
    """
    if options.statistics == "chosen" or count <= options.posterior_samples:
        return False
    return options.statistics == "all" or independent > options.posterior_samples


def sum_samples(
    summing: Summing, samples: Samples, weights: Array | None = None, cancelled: Callable[[], bool] | None = None
) -> ShardStatistics:
    """Return the sums over samples, at least one, chunk by chunk. weights: (N,), one for each sample, None for all one.

    Raise FitCancelledError when `cancelled` returns true.
    """
    total = Total.empty(len(summing.basis))
    for first in range(0, len(samples), CHUNK):
        if cancelled is not None and cancelled():
            raise FitCancelledError("cancelled while statistics were computed")
        part = slice(first, first + CHUNK)
        summing.add(total, samples.rows(part), None if weights is None else weights[part])
    motion = (samples.q, samples.dq, samples.ddq)
    weight = float(len(samples) if weights is None else weights.sum())
    low, high = (np.stack([getattr(each, name)(0) for each in motion]) for name in ("min", "max"))
    return ShardStatistics(total.packed(), total.b, weight, low, high)


def with_statistics(model: TorqueModel, sums: ShardStatistics, count: int) -> TorqueModel:
    """Return the model with the posterior of `count` samples with these sums, instead of those of its fit.

    Hyperparameters and basis do not change.
    """
    updated = _learn(model.posterior, sums)
    spans = {
        name: {"min": sums.low[at].tolist(), "max": sums.high[at].tolist()}
        for at, name in enumerate(("q", "dq", "ddq"))
    }
    return replace(model, posterior=updated, fit={**model.fit, "samples_posterior": count}, training_range=spans)


def _learn(posterior: CompactPosterior, sums: ShardStatistics) -> CompactPosterior:
    """Return the posterior with the same basis from other sums."""
    statistics = Statistics(unpack_symmetric("a", sums.a), sums.b, sums.weight)
    return CompactPosterior.build(
        posterior.kernel,
        posterior.basis,
        statistics,
        posterior.noise_variance,
        posterior.std_factor,
        posterior.misfit,
    )


def condition_arm(posterior: CompactPosterior, samples: Samples, weights: Array) -> CompactPosterior:
    """Return an arm's posterior from samples with weights, (N,), instead of the few that its fit has chosen."""
    return _learn(posterior, sum_samples(Summing.of(posterior), samples, weights))


def condition(
    model: TorqueModel, samples: Samples, weights: Array | None = None, cancelled: Callable[[], bool] | None = None
) -> TorqueModel:
    """Return the model with the posterior of all these samples, instead of the few that its fit has chosen.

    The statistics are summed again, so the choice of the fit does not matter. weights: (N,), one for each sample, None
    for all one. Raise FitCancelledError when `cancelled` returns true.
    """
    return with_statistics(model, sum_samples(Summing.of(model.posterior), samples, weights, cancelled), len(samples))
